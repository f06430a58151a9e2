"""What the commands do, one module each; imported when a command runs."""
