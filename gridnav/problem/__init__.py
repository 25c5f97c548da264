"""What is to be solved: layout, task, reward, distances, metrics."""
