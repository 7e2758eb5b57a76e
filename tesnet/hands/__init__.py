"""Two-finger hands that are known by name, one file each: sizes, forces and where they come from. numpy only.

To add one: a file with a `HAND`, and its line below. Sizes are those of `tesnet.geometry.Gripper`.
"""

from collections.abc import Mapping
from types import MappingProxyType

from tesnet.hands import ag95, franka, hand_e, rg2, rg6, robotiq_2f85, robotiq_2f140, wsg50, xarm
from tesnet.hands.entry import KnownHand

HANDS: Mapping[str, KnownHand] = MappingProxyType(
    {
        module.__name__.rpartition(".")[2]: module.HAND
        for module in (franka, robotiq_2f85, robotiq_2f140, hand_e, rg2, wsg50, xarm, rg6, ag95)
    }
)
"""Every known hand by its name; the first is the default."""

__all__ = ["HANDS", "KnownHand"]
