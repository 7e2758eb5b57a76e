"""Makes the weights: simulated labels, the data set, the fit and its evaluation."""
