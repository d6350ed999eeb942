"""Controllers: PID, open loop, the user's own, and the registry that knows them by name."""
