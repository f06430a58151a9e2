"""Quality of datasets: validation, repair, and the selection of episodes."""
