"""A run live in a browser: images, the cloud with its grasps in 3D, and the rates so far. The only user of viser."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from simharness.metrics import Rate, Summary
from simharness.photographer import observed_colours
from simharness.pictures import FAILURE_COLOUR, OTHER_COLOUR, SUCCESS_COLOUR, hand_lines, segmentation_colours
from simharness.records import OBJECTS_PER_ROUND
from simharness.report import counts
from simharness.round import Attempted, Observed
from simharness.scene import TABLE_HEIGHT

if TYPE_CHECKING:
    from typing_extensions import Self

_EXECUTED_COLOUR = (37, 99, 235)
"""Of the hand while its outcome is not known yet."""

_POINT_SIZE = 0.0015
_LINE_WIDTH = 0.0012


class Watcher:
    """The page, on the loopback interface, for as long as the context lasts. Called with a run's events.

    Args:
        port: where to listen; the next free one is taken.
    """

    def __init__(self, port: int) -> None:
        self._port = port
        self._server: Any = None

    def __enter__(self) -> Self:
        # viser greets on stdout, which belongs to the run's table.
        with redirect_stdout(sys.stderr):
            self._server = viser.ViserServer(host="127.0.0.1", port=self._port, label="clutter removal", verbose=False)
        self._server.scene.set_up_direction("+z")
        self._server.initial_camera.position = (0.55, -0.35, 0.5)
        self._server.initial_camera.look_at = (0.15, 0.15, TABLE_HEIGHT)
        self._server.scene.add_box(
            "/table", color=(226, 232, 240), dimensions=(0.3, 0.3, 0.002), position=(0.15, 0.15, TABLE_HEIGHT - 0.001)
        )
        gui = self._server.gui
        self._rates = gui.add_markdown("Waiting for the first round.")
        self._status = gui.add_markdown("")
        blank = np.full((480, 640, 3), 246, dtype=np.uint8)
        self._colour = gui.add_image(blank, label="colour", format="jpeg")
        self._segmentation = gui.add_image(blank, label="segmentation", format="png")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with redirect_stdout(sys.stderr):
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
            f"**GSR {_rate(summary.gsr)}** ({summary.gsr.count} of {summary.gsr.total}) "
            f"**DR {_rate(summary.dr)}** ({summary.dr.count} of {summary.dr.total})\n\n"
            f"{summary.rounds} rounds; failures: {counts(summary.failures)}"
        )

    def _observed(self, event: Observed) -> None:
        images = event.view.images[0]
        plan = event.plan
        with self._server.atomic():
            self._colour.image = images.colour
            self._segmentation.image = segmentation_colours(images.segmentation, event.objects)
            self._server.scene.add_point_cloud(
                "/cloud", np.asarray(event.view.points_world), observed_colours(event), point_size=_POINT_SIZE
            )
            others = [
                hand_lines(plan.Ts_world_grasp[index], float(plan.widths[index])) for index in range(1, len(plan))
            ]
            self._hands("/grasps", others, OTHER_COLOUR)
            best = [hand_lines(plan.Ts_world_grasp[0], float(plan.widths[0]))] if len(plan) else []
            self._hands("/executed", best, _EXECUTED_COLOUR)
        found = f"{len(plan)} grasps, best score {plan.scores[0]:.3f}" if len(plan) else f"no grasp: {plan.reason}"
        self._status.content = (
            f"Seed {event.seed}, round {event.round}, observation {event.observation}: "
            f"{len(event.objects)} of up to {OBJECTS_PER_ROUND} objects left. {found}"
        )

    def _attempted(self, event: Attempted) -> None:
        record = event.record
        colour = SUCCESS_COLOUR if record.success else FAILURE_COLOUR
        self._hands("/executed", [hand_lines(record.T_world_grasp, record.width)], colour)
        self._status.content = (
            f"Seed {record.seed}, round {record.round}, attempt {record.attempt}: **{record.outcome}**"
        )

    def _hands(self, name: str, hands: list[Any], colour: tuple[int, int, int]) -> None:
        segments = np.concatenate(hands).astype(np.float32) if hands else np.zeros((1, 2, 3), dtype=np.float32)
        self._server.scene.add_line_segments(
            name, segments, np.array(colour, dtype=np.uint8), thickness=_LINE_WIDTH, visible=bool(hands)
        )


def _rate(rate: Rate) -> str:
    return "-" if rate.value is None else f"{100 * rate.value:.1f} %"
