"""A run live in a browser: images, the cloud with its grasps in 3D, and the rates so far. The only user of viser."""

from __future__ import annotations

import importlib
import io
from contextlib import redirect_stdout
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from simharness.errors import from_extra
from simharness.play.metrics import Summary
from simharness.play.photographer import observed_colours
from simharness.play.pictures import (
    FAILURE_COLOUR,
    OTHER_COLOUR,
    PICTURE_SIZE,
    SUCCESS_COLOUR,
    close_up,
    hand_lines,
    picture,
    segmentation_colours,
)
from simharness.play.records import OBJECTS_PER_ROUND
from simharness.play.round import Attempted, Observed
from simharness.report.report import counts, percent
from simharness.sim.scene import TABLE_HEIGHT

if TYPE_CHECKING:
    from typing_extensions import Self

_EXECUTED_COLOUR = (37, 99, 235)
"""Of the hand while its outcome is not known yet."""

_POINT_SIZE = 0.0015
_LINE_WIDTH = 0.0008
_EXECUTED_LINE_WIDTH = 0.003

_CAMERA_POSITION = (0.38, -0.13, 0.30)
_CAMERA_TARGET = (0.15, 0.15, 0.08)
_LEGEND = "Hands: blue is about to be carried out, green succeeded, red failed, grey are the next best."


class Watcher:
    """The page, on the loopback interface, for as long as the context lasts. Called with a run's events.

    Args:
        port: where to listen; the next free one is taken.
    """

    def __init__(self, port: int) -> None:
        self._port = port
        self._server: Any = None

    def __enter__(self) -> Self:
        with from_extra("watch", "--watch needs"):
            viser: Any = importlib.import_module("viser")
        # viser greets on stdout, which belongs to the run's table.
        with redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(host="127.0.0.1", port=self._port, label="Clutter removal", verbose=False)
        scene = self._server.scene
        scene.set_up_direction("+z")
        self._server.initial_camera.position = _CAMERA_POSITION
        self._server.initial_camera.look_at = _CAMERA_TARGET
        scene.add_box(
            "/table", color=(226, 232, 240), dimensions=(0.3, 0.3, 0.002), position=(0.15, 0.15, TABLE_HEIGHT - 0.001)
        )
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._rates = gui.add_markdown("Waiting for the first round.")
        self._status = gui.add_markdown("")
        blank = np.full((*reversed(PICTURE_SIZE), 3), 246, dtype=np.uint8)
        self._colour = gui.add_image(blank, label="Camera, colour", format="png")
        self._segmentation = gui.add_image(blank, label="Camera, segmentation", format="png")
        gui.add_markdown(_LEGEND)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self._server.get_port()}"

    def __call__(self, event: Observed | Attempted) -> None:
        """Show an event."""
        if isinstance(event, Observed):
            self._observed(event)
        else:
            self._attempted(event)

    def show_summary(self, summary: Summary) -> None:
        """Show the rates of the rounds so far."""
        self._rates.content = (
            f"**GSR {percent(summary.gsr)}** ({summary.gsr.count} of {summary.gsr.total} attempts)  \n"
            f"**DR {percent(summary.dr)}** ({summary.dr.count} of {summary.dr.total} objects)\n\n"
            f"Rounds finished: {summary.rounds}; failures: {counts(summary.failures)}"
        )

    def _observed(self, event: Observed) -> None:
        images = event.view.images[0]
        plan = event.plan
        found = f"{len(plan)} grasps, best score {plan.scores[0]:.3f}" if len(plan) else f"no grasp: {plan.reason}"
        # Grouped, so that words and pictures change together as far as the browser keeps up.
        with self._server.atomic():
            self._status.content = (
                f"Seed {event.seed}, round {event.round}, observation {event.observation}: "
                f"{len(event.objects)} of up to {OBJECTS_PER_ROUND} objects left. {found}"
            )
            part = close_up(images.segmentation, event.objects)
            segmentation = segmentation_colours(images.segmentation, event.objects)
            self._colour.image = np.asarray(picture(images.colour[part]))
            self._segmentation.image = np.asarray(picture(segmentation[part]))
            self._server.scene.add_point_cloud(
                "/cloud",
                np.asarray(event.view.points_world),
                observed_colours(event),
                point_size=_POINT_SIZE,
                point_shape="circle",
                precision="float32",
            )
            others = [
                hand_lines(plan.Ts_world_grasp[index], float(plan.widths[index]), event.gripper)
                for index in range(1, len(plan))
            ]
            self._hands("/grasps", others, OTHER_COLOUR, _LINE_WIDTH)
            best = [hand_lines(plan.Ts_world_grasp[0], float(plan.widths[0]), event.gripper)] if len(plan) else []
            self._hands("/executed", best, _EXECUTED_COLOUR, _EXECUTED_LINE_WIDTH)

    def _attempted(self, event: Attempted) -> None:
        record = event.record
        colour = SUCCESS_COLOUR if record.success else FAILURE_COLOUR
        with self._server.atomic():
            self._status.content = (
                f"Seed {record.seed}, round {record.round}, attempt {record.attempt}: **{record.outcome}**"
            )
            self._hands(
                "/executed",
                [hand_lines(record.T_world_grasp, record.width, event.before.gripper)],
                colour,
                _EXECUTED_LINE_WIDTH,
            )

    def _hands(self, name: str, hands: list[Any], colour: tuple[int, int, int], thickness: float) -> None:
        segments = np.concatenate(hands).astype(np.float32) if hands else np.zeros((1, 2, 3), dtype=np.float32)
        self._server.scene.add_line_segments(
            name, segments, np.array(colour, dtype=np.uint8), thickness=thickness, visible=bool(hands)
        )
