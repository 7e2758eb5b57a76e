"""Shapes made from a seed: a training set, and three sets to validate with that share no family with it."""
