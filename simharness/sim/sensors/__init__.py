"""What depth cameras do to what they see: one model a file, from its published formula; `catalogue` names them.

Every random number comes from a generator that is given. Nothing here knows the simulator.
"""
