"""What is wrong with a capture before training, and with a scene after it, in plain words."""
