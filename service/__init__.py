"""The HTTP face of the grasp predictor: `python -m service`. Knows tesnet; nothing of training or simulation."""
