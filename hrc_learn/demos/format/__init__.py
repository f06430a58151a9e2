"""What stands where in a LeRobot dataset."""
