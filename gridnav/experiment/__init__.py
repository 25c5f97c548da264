"""What one does with worlds and agents: train, evaluate, climb the ladder."""
