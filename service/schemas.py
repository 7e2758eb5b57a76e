"""The wire format of the grasp service: the only source of it, and of its documentation at `/docs`.

pydantic only: the client parses answers with these models, so neither torch nor FastAPI may be needed here.
Positions and lengths are metres, in the frame of the request's points ("the cloud frame"), unless a name says
otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from tesnet.geometry import PANDA, WIDEST, FrameConvention, PartName
from tesnet.hands import HANDS
from tesnet.query import LARGE_HAND, MAX_APPROACH_POINTS, MAX_CANDIDATES, MAX_GRASPS, MAX_SEED, MAX_VIEWPOINTS
from tesnet.result import Reason

REQUEST_ID = r"[A-Za-z0-9._:/+=-]{1,128}"
"""What a client may call its request in X-Request-ID; a request that comes with anything else is given a name."""

MAX_TIMEOUT_S = 3600.0
"""The longest deadline that a request may give in X-Request-Timeout, seconds."""

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
MatrixRow = tuple[float, float, float, float]
Matrix = tuple[MatrixRow, MatrixRow, MatrixRow, MatrixRow]


class RequestPart(BaseModel):
    """Part of a request: unknown names, strings in place of numbers, NaN and infinities are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class Box(RequestPart):
    """Axis-aligned box in the cloud frame."""

    min: Vector = Field(description="Lower corner x, y, z in metres.")
    max: Vector = Field(description="Upper corner x, y, z in metres; above `min` on every axis.")


class Approach(RequestPart):
    """A cone of directions in which the hand may travel (the grasp's +z)."""

    direction: Vector = Field(description="Axis of the cone in the cloud frame, of any length. Top-down is `-up`.")
    max_angle_deg: float = Field(ge=0, le=180, description="Half angle of the cone in degrees, 0 to 180.")


class Separation(RequestPart):
    """How different two returned grasps must be; half a turn about the approach axis makes no difference."""

    translation: float = Field(default=0.01, ge=0, le=1, description="Metres between the origins, 0 to 1.")
    rotation_deg: float = Field(default=15.0, ge=0, le=180, description="Degrees between the orientations, 0 to 180.")


class Target(RequestPart):
    """Where to grasp: a box, some of the points, or what a mask labels. Exactly one of the three."""

    box: Box | None = Field(default=None, description="Approach and contact point lie in this box.")
    indices: Sequence[Annotated[int, Field(ge=0, lt=2**31)]] | None = Field(
        default=None,
        description="Numbers of the target's points, from 0: rows of the posted cloud, or pixels of a depth image row "
        "by row. Mark all points of the object: a cell of the voxel grid is the target's where half of its points are, "
        "and fingers close on nothing that lies 5 mm or more beside it.",
    )
    label: Annotated[int, Field(ge=0, le=65_535)] | None = Field(
        default=None, description="Number of the target's pixels in the file `mask`, which comes with a depth image."
    )

    @model_validator(mode="after")
    def _one_of_three(self) -> Target:
        if sum(value is not None for value in (self.box, self.indices, self.label)) != 1:
            raise ValueError("give either `box` or `indices`, or `label` beside a mask")
        return self


Length = Annotated[float, Field(gt=0, le=0.5)]


class GripperSize(RequestPart):
    """A two-finger hand with parallel pads, metres; what is left out is that of the hand that `name` names.

    A part whose size is given is straight, unless its narrower end is given as well. Defaults are the Franka hand's.
    """

    name: str | None = Field(
        default="franka", max_length=64, description=f"A known hand that this one is like: {', '.join(HANDS)}."
    )
    max_width: Annotated[float, Field(ge=0.005, le=WIDEST)] = Field(
        default=PANDA.max_width,
        description=f"Opening between the pads, 0.005 to {WIDEST:g}; a hand that opens wider can be told to open less.",
    )
    finger_depth: Annotated[float, Field(ge=0.015, le=0.5)] = Field(
        default=PANDA.finger_depth, description="Usable length of the fingers, measured back from the tips."
    )
    finger_thickness: Length = Field(
        default=PANDA.finger_thickness, description="Extent of one finger along the closing direction, at its root."
    )
    finger_tip_thickness: Length = Field(default=PANDA.finger_tip_thickness, description="The same, at its tip.")
    finger_taper: Length = Field(
        default=PANDA.finger_taper, description="Over how much of its length, from the tip, a finger gets thicker."
    )
    finger_breadth: Length = Field(
        default=PANDA.finger_breadth, description="Extent of one finger across the hand's plane."
    )
    finger_tip_breadth: Length = Field(default=PANDA.finger_tip_breadth, description="The same, at its very tip.")
    palm_depth: Length = Field(
        default=PANDA.palm_depth, description="Extent of the hand's body along the direction of travel."
    )
    palm_length: Length = Field(
        default=PANDA.palm_length, description="Extent of the hand's body along the closing direction."
    )
    palm_breadth: Length = Field(
        default=PANDA.palm_breadth, description="Extent of the hand's body across the hand's plane."
    )
    palm_front_breadth: Length = Field(default=PANDA.palm_front_breadth, description="The same, at the fingers.")
    palm_taper: Length = Field(
        default=PANDA.palm_taper, description="Over how much of its depth, from the fingers, the body gets broader."
    )
    tip_offset: Length = Field(
        default=PANDA.tip_offset, description="How far the fingertips lie beyond the TCP, the middle of the pads."
    )
    hand_to_tcp: Length = Field(
        default=PANDA.hand_to_tcp, description="From the hand's base link to the TCP of the open hand, along z."
    )
    hand_yaw: Annotated[float, Field(ge=-pi, le=pi)] = Field(
        default=PANDA.hand_yaw,
        description="Angle about z from the grasp's axes to the base link's, radians; pi / 2 where the link closes "
        "along its x.",
    )
    linkage_length: Length | None = Field(
        default=None,
        description="Of fingers on parallel cranks, whose tips also move along z: the cranks' length L. From the base "
        "link the tips are at A + sqrt(L^2 - (width / 2 - B)^2). Default: the fingers slide.",
    )
    linkage_offset: Annotated[float, Field(ge=-0.5, le=0.5)] = Field(
        default=PANDA.linkage_offset, description="B: half the opening at which the cranks point straight ahead."
    )


class GraspOptions(RequestPart):
    """Every option of `POST /grasps`, all optional, with the same names in a JSON body and in a query string."""

    viewpoint: Vector | Annotated[list[Vector], Field(min_length=1, max_length=MAX_VIEWPOINTS)] | None = Field(
        default=None,
        description=f"Camera position [x, y, z] in the cloud frame, or a list of up to {MAX_VIEWPOINTS} of them for a "
        "fused cloud; turns normals towards the camera. Default: the camera of a depth image; of a cloud the origin, "
        "and `warnings` says so.",
    )
    up: Vector | Literal["auto"] | None = Field(
        default=None,
        description="Direction [x, y, z] against gravity in the cloud frame, of any length. `auto` finds the plane "
        "that things stand on, of several the nearest to the camera that has some: its normal is up, its height "
        "`support_height`; `warnings` gives the figures. Default: `auto` for a depth image; for a cloud none, so "
        "grasps from below are not filtered, only those from behind what the camera sees, and `warnings` says so.",
    )
    workspace: Box | None = Field(
        default=None,
        description='Box {"min": [x, y, z], "max": [x, y, z]} in metres; points outside count for collision alone. '
        "With `up` the scores allow for what may stand beyond its upright sides. Default: none.",
    )
    support_height: float | Literal["auto"] | None = Field(
        default=None,
        description="Height of the support plane along `up` in metres (needs `up`): points lower than 5 mm above it "
        "(down to 2 mm where a quiet camera sees it there) are dropped, and the hand stays "
        "4 mm clear of it, or 1.5 mm where a thing is too thin for more: the height is "
        "taken to be exact. Tips that swing forward come lower if they close on nothing. `auto` finds the plane that "
        "things stand on, keeps clear of its noise as well, and `warnings` says where; without a `target`, grasps are "
        "then looked for on those things alone, up to 0.35 m above it. Default: none, and `warnings` says so where "
        "`up` is given and a large plane is seen.",
    )
    target: Target | None = Field(
        default=None,
        description='Where to grasp: {"box": {"min": [x, y, z], "max": [x, y, z]}} or {"indices": [whole numbers]}, '
        'the posted points by their number from 0, or {"label": whole number} of a mask. Candidates come from it '
        "alone; the other points still count for collision. Default: everything.",
    )
    approach: Approach | None = Field(
        default=None,
        description='Cone {"direction": [x, y, z], "max_angle_deg": 0 to 180} for the direction of travel. '
        "Default: none.",
    )
    max_grasps: int = Field(
        default=10, ge=1, le=MAX_GRASPS, description=f"How many grasps to return, 1 to {MAX_GRASPS}."
    )
    min_score: float = Field(default=0.0, ge=0, le=1, description="Least score of a returned grasp, 0 to 1.")
    min_separation: Separation = Field(
        default_factory=Separation,
        description='Least difference {"translation": metres, "rotation_deg": degrees} between returned grasps; one '
        "that is nearer than both to a better one is dropped.",
    )
    num_approach_points: int = Field(
        default=32,
        ge=1,
        le=MAX_APPROACH_POINTS,
        description=f"Search effort: approach points to begin with, 1 to {MAX_APPROACH_POINTS}. While they "
        "yield fewer than half of `max_candidates` candidates, as beside flat objects, four times as many are tried.",
    )
    max_candidates: int = Field(
        default=2000,
        ge=1,
        le=MAX_CANDIDATES,
        description=f"Search effort: candidates of one search, 1 to {MAX_CANDIDATES}. While the best score is under "
        "0.9, up to four other searches follow, with four times as many approach points; the answer is that of the "
        "best one.",
    )
    gripper: GripperSize | Annotated[str, Field(max_length=64)] | None = Field(
        default=None,
        description=f"The hand: a name, one of {', '.join(HANDS)}; or sizes "
        '{"max_width": metres, "finger_depth": metres, ...}; or both, {"name": ..., ...}, the named hand with the '
        "sizes that differ. Sizes left out are Franka's, so `hand_pose` needs `hand_to_tcp` and `hand_yaw`. It opens "
        f"at most {WIDEST:g}. Default: franka.",
    )
    width: Literal["fitted", "full"] | None = Field(
        default=None,
        description="How far the hand opens before it approaches: by what was seen between its fingers and a margin, "
        "or all it can. Fitted, it clears neighbours that it would hit wide open, but not what nobody saw. Default: "
        "full, but fitted for hands whose tips swing forward as they close.",
    )
    unseen: Literal["free", "occupied"] = Field(
        default="free",
        description="What the collision check takes the shadow behind observed points for: free or occupied.",
    )
    calibrate: bool = Field(
        default=False,
        description="Solve each view's depth scale and a small tilt from the support that it sees, whose `up` and "
        "`support_height` must be known, and correct its points about its `viewpoint` before anything else. "
        "`warnings` says what was corrected, or why nothing was.",
    )
    pregrasp_distance: float = Field(
        default=0.05, ge=0, le=1, description="How far behind the grasp `pregrasp` lies, metres, 0 to 1."
    )
    frame_convention: FrameConvention = Field(
        default="panda",
        description="Axes and origin of `position`, `quaternion_xyzw`, `matrix`: panda, graspnet or contact_graspnet.",
    )
    seed: int = Field(default=0, ge=0, le=MAX_SEED, description="Makes sampling repeatable, 0 to 2^63 - 1.")
    model: str | None = Field(
        default=None,
        max_length=64,
        description="One of the networks that `GET /model` lists. Default: the first, tesnet where it is loaded.",
    )


class GraspRequest(GraspOptions):
    """Body of `POST /grasps` as `application/json`. `service.payloads` decodes the points, not this model."""

    points: list[Vector] = Field(description="The point cloud: [[x, y, z], ...] in metres, finite.")
    view_index: list[Annotated[int, Field(ge=0, lt=MAX_VIEWPOINTS)]] | None = Field(
        default=None,
        description="Which of the positions of `viewpoint` saw each point, from 0; turns its normal. Default: the one "
        "most nearly along the normal.",
    )
    normals: list[Vector] | None = Field(
        default=None,
        description="Normals [[x, y, z], ...] of the points, outward, of any length, zeros where there is none; turn "
        "the normals that are computed. Default: none.",
    )


class Intrinsics(RequestPart):
    """A pinhole camera without distortion, pixels."""

    fx: float = Field(gt=0, le=1e6, description="Focal length along a row.")
    fy: float = Field(gt=0, le=1e6, description="Focal length along a column.")
    cx: float = Field(ge=-1e6, le=1e6, description="Column of the optical axis; the first pixel's centre is 0.")
    cy: float = Field(ge=-1e6, le=1e6, description="Row of the optical axis.")


class DepthCamera(RequestPart):
    """What a depth image needs to become a cloud."""

    intrinsics: Intrinsics = Field(description='Camera {"fx": ..., "fy": ..., "cx": ..., "cy": ...} in pixels.')
    T_cloud_camera: Matrix | None = Field(
        default=None,
        description="Camera pose as a 4 x 4 matrix, row by row; camera axes are +x right, +y down, +z forward. "
        "Rounded ones are made orthonormal, where R R^T differs from the identity by at most 0.005. Default: the cloud "
        "frame is the camera frame.",
    )
    depth_scale: float = Field(default=0.001, gt=0, le=1, description="Metres per count, more than 0, at most 1.")
    stride: int = Field(
        default=1, ge=1, le=64, description="Every so many-th row and column of the image is used, 1 to 64."
    )


class DepthOptions(GraspOptions, DepthCamera):
    """The options of a request with a depth image."""


class ResponsePart(BaseModel):
    """Part of an answer. Later versions may add fields: readers ignore names they do not know."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class PoseOut(ResponsePart):
    """A pose in the cloud frame."""

    position: Vector = Field(description="Origin x, y, z in metres.")
    quaternion_xyzw: Quaternion = Field(description="Unit quaternion x, y, z, w.")


class GraspOut(ResponsePart):
    """One grasp, in the cloud frame. In the panda convention +z is the direction of travel, +y the closing one."""

    score: float = Field(description="Probability from 0 to 1 that the grasp succeeds.")
    position: Vector = Field(
        description="Origin in metres: the TCP, midway between the finger pads (see frame_convention)."
    )
    quaternion_xyzw: Quaternion = Field(description="Unit quaternion x, y, z, w of the axes of frame_convention.")
    matrix: Matrix = Field(description="The same pose as a 4 x 4 matrix T_cloud_grasp, row by row.")
    hand_pose: PoseOut = Field(
        description="Pose of the hand's base link, open by `width`, in its own axes always. Of the Franka hand that is "
        "`panda_hand`, 0.1034 m behind the TCP."
    )
    pregrasp: PoseOut = Field(description="TCP pose `pregrasp_distance` behind the grasp; Panda axes always.")
    width: float = Field(description="Opening to set before approaching, metres.")
    approach_point: Vector = Field(
        description="Cloud point that the grasp was made from, metres; the hand's middle may lie beside it along y."
    )
    contact_point: Vector = Field(description="Cloud point on which one fingertip closes, metres.")


class ModelIdentity(ResponsePart):
    """Which network scored the grasps."""

    name: str = Field(description="Name of the network.")
    version: str = Field(description="Version of its weights.")
    weights_sha256: str | None = Field(
        description="SHA-256 of the weights file, in hexadecimal; null for a network without weights."
    )


class RejectedOut(ResponsePart):
    """Candidates dropped by each step; one that several would drop counts at the first of them only."""

    support: int = Field(
        description="The hand would come too near to the support plane: within 4 mm, or 1.5 mm of thin things."
    )
    from_below: int = Field(
        description="The hand would come from below or, without `up`, from behind what the camera sees."
    )
    approach: int = Field(description="The direction of travel is outside the `approach` cone.")
    target: int = Field(description="Not on the target, or the fingers would close on something beside it as well.")
    collision: int = Field(
        description="The hand would collide with observed points, or with the shadow behind them (`unseen`)."
    )
    min_score: int = Field(description="Score below `min_score`.")
    duplicates: int = Field(description="Too near a better grasp (`min_separation`).")


class CountsOut(ResponsePart):
    """The account of points and candidates: what each step left."""

    points: int = Field(description="Points in the request: finite ones, and pixels with a depth.")
    ignored_points: int = Field(default=0, description="Rows of the request with NaN or an infinity, left out.")
    prepared_points: int = Field(description="Points left by crop, voxel grid and outlier removal.")
    candidates: int = Field(description="Candidates found.")
    collision_free: int = Field(description="Candidates whose hand does not collide.")
    returned: int = Field(description="Grasps in this answer.")
    rejected: RejectedOut


class TimingsOut(ResponsePart):
    """Milliseconds spent in each stage."""

    decode: float = Field(description="Body to checked point cloud.")
    queue: float = Field(description="Waiting for the predictor.")
    prepare: float = Field(description="Crop, voxel grid, outliers, normals, neighbours.")
    candidates: float = Field(description="Candidate grasps, their geometric masks and the collision check.")
    network: float = Field(description="Encoding the cloud and scoring candidates.")
    rank: float = Field(description="`min_score`, order, `min_separation`.")
    total: float = Field(description="From the last byte of the request to the grasps.")


class GraspResponse(ResponsePart):
    """Answer of `POST /grasps`: grasps by score, best first."""

    grasps: list[GraspOut] = Field(description="Best first; empty with a `reason` where nothing was found.")
    frame: Literal["cloud"] = Field(description="Every pose is in the frame of the request's points.")
    model: ModelIdentity
    counts: CountsOut
    reason: Reason | None = Field(description="Why `grasps` is empty; null when it is not.")
    warnings: list[str] = Field(description="What the caller should know about the request.")
    timings_ms: TimingsOut
    request_id: str = Field(description="X-Request-ID of this request.")
    gripper: GripperOut | None = Field(default=None, description="The hand that the grasps are for.")


class Problem(ResponsePart):
    """A problem document (RFC 9457), `application/problem+json`."""

    type: str = Field(description="URN that names the kind of problem.")
    title: str = Field(description="The kind of problem, in a few words.")
    status: int = Field(description="The HTTP status.")
    detail: str = Field(description="What was found, what is allowed, and what to do.")
    request_id: str = Field(description="X-Request-ID of this request.")
    field: str | None = Field(default=None, description="The option or header at fault, where there is one.")
    error: str | None = Field(
        default=None, description="`detail` again, on routes of the Open Inference Protocol, whose clients read this."
    )


class Health(ResponsePart):
    """State of the process."""

    status: Literal["live", "ready"] = Field(description="`live`: the process works; `ready`: it takes requests.")


class SectionOut(ResponsePart):
    """A rectangle across the direction of travel, metres."""

    z: float = Field(description="Where it is along z of the grasp frame, whose origin is the TCP.")
    breadth: float = Field(description="Its extent along x, about x = 0.")
    thickness: float = Field(description="Its extent along y: about y = 0, or outwards from a finger's inner face.")


class PartOut(ResponsePart):
    """One solid of the hand: the convex hull of its sections."""

    name: PartName = Field(description="What it is called.")
    side: Literal[-1, 0, 1] = Field(
        description="0: it lies about the hand's middle; 1, -1: a finger, whose inner face lies at `side * width / 2` "
        "along y."
    )
    sections: list[SectionOut] = Field(description="From its front to its back.")


class GripperOut(ResponsePart):
    """A hand, by the names and in the units of a request's `gripper`."""

    name: str | None = Field(default=None, description="Its name, if it is a known hand.")
    max_width: float = Field(description="Largest opening between the finger pads.")
    finger_depth: float = Field(description="Usable length of the fingers, measured back from the tips.")
    finger_thickness: float = Field(description="Extent of one finger along the closing direction.")
    finger_tip_thickness: float | None = Field(default=None, description="The same, at its tip.")
    finger_taper: float | None = Field(default=None, description="Over how much of its length a finger gets thicker.")
    finger_breadth: float = Field(description="Extent of one finger across the hand's plane.")
    finger_tip_breadth: float | None = Field(default=None, description="The same, at its very tip.")
    palm_depth: float | None = Field(default=None, description="Extent of the body along the direction of travel.")
    palm_length: float | None = Field(default=None, description="Its extent along the closing direction.")
    palm_breadth: float | None = Field(default=None, description="Its extent across the hand's plane.")
    palm_front_breadth: float | None = Field(default=None, description="The same, at the fingers.")
    palm_taper: float | None = Field(default=None, description="Over how much of its depth the body gets broader.")
    tip_offset: float | None = Field(default=None, description="How far the fingertips lie beyond the TCP.")
    hand_to_tcp: float = Field(description="From the hand's base link to the TCP of the open hand, along z.")
    hand_yaw: float | None = Field(default=None, description="Angle about z from the grasp's axes to the base link's.")
    linkage_length: float | None = Field(default=None, description="L, if the tips move along z as the hand closes.")
    linkage_offset: float | None = Field(default=None, description="B of such a hand.")
    parts: list[PartOut] = Field(
        default_factory=list, description="The solids that the collision check takes the hand for."
    )


class HandOut(GripperOut):
    """A known hand."""

    min_force: float = Field(description="The least force that it can be told to press with, newtons.")
    max_force: float = Field(description="The greatest one.")
    max_payload: float = Field(description="What it carries by friction, kilograms.")
    simulated: bool = Field(description="Whether results in simulation are claimed for it.")


class LimitsOut(ResponsePart):
    """What the service accepts."""

    max_points: int = Field(description="Points in a request.")
    max_body_bytes: int = Field(description="Bytes in a request's body.")
    max_grasps: int = Field(description="Largest `max_grasps`.")
    max_approach_points: int = Field(description="Largest `num_approach_points`.")
    max_candidates: int = Field(description="Largest `max_candidates`.")
    max_candidates_of_large_hands: int = Field(
        description=f"Candidates that are looked for at most where a part of the hand is longer than {LARGE_HAND:g} m."
    )
    queue_size: int = Field(description="Requests that may wait for the predictor.")
    max_timeout_s: float = Field(description="Largest X-Request-Timeout, seconds.")


class NetworkOut(ModelIdentity):
    """A loaded network."""

    card: dict[str, object] = Field(description="How the weights came to be: data, seed, metrics.")
    configuration: dict[str, object] = Field(description="Every number that travels with the weights.")


class ModelResponse(ResponsePart):
    """Answer of `GET /model`."""

    models: list[NetworkOut] = Field(
        description="The loaded networks; the first is the default: tesnet where it is loaded."
    )
    gripper: GripperOut = Field(description="The default hand.")
    hands: list[HandOut] = Field(
        default_factory=list, description="Every hand that a request's `gripper` may name; the first is the default."
    )
    frame_conventions: list[str] = Field(description="Valid values of `frame_convention`.")
    content_types: list[str] = Field(description="Content types that `POST /grasps` decodes.")
    limits: LimitsOut
    device: str = Field(description="Compute device of the predictor.")


class TensorMetadata(ResponsePart):
    """A tensor of the Open Inference Protocol."""

    name: str = Field(description="Its name.")
    datatype: str = Field(description="FP32, FP64 or BYTES.")
    shape: list[int] = Field(description="Its axes; -1 is any length.")


class ModelMetadata(ResponsePart):
    """Answer of `GET /v2/models/tesnet`."""

    name: str = Field(description="Name of the network.")
    versions: list[str] = Field(description="The loaded version of its weights.")
    platform: str = Field(description="What computes it.")
    inputs: list[TensorMetadata] = Field(description="Tensors that `infer` takes.")
    outputs: list[TensorMetadata] = Field(description="Tensors that `infer` gives.")


class ServerMetadata(ResponsePart):
    """Answer of `GET /v2`."""

    name: str = Field(description="Name of the server.")
    version: str = Field(description="Version of the server.")
    extensions: list[str] = Field(description="Extensions of the protocol that it knows.")
