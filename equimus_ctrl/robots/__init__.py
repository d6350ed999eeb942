"""What robots are: one interface, and the kinds of robots that have it."""
