"""The simulated table: objects, scenes, cameras, the hand, and what becomes of an attempt. Knows no service."""
