"""What changes the Gaussians: the loop, the strategy and the learned gate, and checkpoints of all of it."""
