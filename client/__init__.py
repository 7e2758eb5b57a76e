"""The Python client of the grasp service: points in, ranked grasps out.

Pulls in numpy, httpx and pydantic only, so a robot's control computer can install it alone::

    with GraspClient("http://127.0.0.1:8000") as client:
        reply = client.grasps(points_camera, viewpoint=(0, 0, 0), up=(0, -1, 0))
        if reply.grasps:
            T_camera_grasp = reply.grasps[0].pose
"""

from client.errors import (
    BadRequest,
    DeadlineExceeded,
    GraspClientError,
    InvalidArgument,
    InvalidRequest,
    Overloaded,
    PayloadTooLarge,
    ProblemError,
    ServiceFault,
    ServiceTimeout,
    ServiceUnreachable,
    Unauthorized,
    UnexpectedResponse,
    UnsupportedMediaType,
)
from client.reply import Counts, Grasp, GraspReply, Limits, ModelIdentity, ModelReply
from client.request import GraspOptions, GripperSize, Intrinsics
from client.retry import RetryPolicy
from client.session import AsyncGraspClient, GraspClient

__all__ = [
    "AsyncGraspClient",
    "BadRequest",
    "Counts",
    "DeadlineExceeded",
    "Grasp",
    "GraspClient",
    "GraspClientError",
    "GraspOptions",
    "GraspReply",
    "GripperSize",
    "Intrinsics",
    "InvalidArgument",
    "InvalidRequest",
    "Limits",
    "ModelIdentity",
    "ModelReply",
    "Overloaded",
    "PayloadTooLarge",
    "ProblemError",
    "RetryPolicy",
    "ServiceFault",
    "ServiceTimeout",
    "ServiceUnreachable",
    "Unauthorized",
    "UnexpectedResponse",
    "UnsupportedMediaType",
]
