"""Rounds and runs: a planner is asked, its grasp is tried, and what happened is recorded."""
