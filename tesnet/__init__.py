"""The model library: a point cloud becomes ranked SE(3) grasps. Knows no HTTP and no simulator.

Importing this package pulls in nothing; import what you need from its modules.
"""
