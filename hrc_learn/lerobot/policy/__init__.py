"""Policies for LeRobot that plan motions."""
