"""Studies of the method and of the program, with their reports."""
