"""Where the runs of a sweep are done: processes of this machine or a Ray cluster, behind one protocol."""
