"""Plants take pressures and give joint angles: simulated, replayed."""
