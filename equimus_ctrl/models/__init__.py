"""What a robot is: its morphology, and from it the MJCF and the symbolic reduced dynamics."""
