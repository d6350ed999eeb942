"""What a controller may know of a robot from angles and commands alone."""
