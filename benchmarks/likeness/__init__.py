"""How alike simulated and real measurements are: frames, statistics, distances, a classifier and pictures."""
