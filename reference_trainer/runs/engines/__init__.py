"""Where the runs of a sweep execute: processes on this machine or a Ray cluster, behind one protocol."""
