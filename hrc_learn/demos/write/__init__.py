"""Recording demonstrations as LeRobot datasets."""
