"""Frozen geometric values: poses, boxes, cameras, the gripper, grasps. numpy only: a robot's computer needs no more."""

from tesnet.geometry.box import Box
from tesnet.geometry.camera import CameraIntrinsics
from tesnet.geometry.grasp import FRAME_CONVENTIONS, FrameConvention, GraspSet
from tesnet.geometry.gripper import NARROWEST, PANDA, WIDEST, Gripper
from tesnet.geometry.part import Extent, Part, PartName, Section
from tesnet.geometry.pose import Pose, quaternions_xyzw, unit

__all__ = [
    "FRAME_CONVENTIONS",
    "NARROWEST",
    "PANDA",
    "WIDEST",
    "Box",
    "CameraIntrinsics",
    "Extent",
    "FrameConvention",
    "GraspSet",
    "Gripper",
    "Part",
    "PartName",
    "Pose",
    "Section",
    "quaternions_xyzw",
    "unit",
]
