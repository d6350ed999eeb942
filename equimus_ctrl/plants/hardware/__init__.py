"""A real robot behind a transport: calibration, one clock, a fixed rate, and limits that no controller can lift."""
