"""Studies of the method and of this package, with their reports."""
