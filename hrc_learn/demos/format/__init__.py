"""Format of LeRobot datasets: metadata, files and videos."""
