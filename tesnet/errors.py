"""Everything the model library raises on purpose.

::

    TesnetError
    +-- InvalidQuery     a cloud or an option that no grasp can be computed from; `field` names it
    +-- UnreadableFile   a cloud file that is damaged, or of another format than its reader's
    +-- TooManyPoints    a cloud file with more points than the caller's limit
    +-- WeightsError     a weights file that is missing, corrupted or of another network; `path` names it
    +-- DeviceError      a compute device that this machine does not have
    +-- GaveUp           a prediction that nobody waits for any more

Messages give the value, the limit and the remedy. They never contain the cloud.
"""

from __future__ import annotations

from pathlib import Path

_MOST_SHOWN = 10**15
"""A header can claim a number of thousands of digits, which no message should repeat."""


class TesnetError(Exception):
    """Base class of this package's errors."""


class InvalidQuery(TesnetError):
    """A query's field holds a value that cannot be used.

    Args:
        field: name of the option, as on the wire (`points`, `viewpoint`, ...).
        message: the value, the limit and the remedy.
    """

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message


class UnreadableFile(TesnetError):
    """The content of a cloud file is damaged, or is no file of that format."""


class TooManyPoints(TesnetError):
    """A cloud has more points than may be.

    Args:
        count: how many it has or claims to have; words where they were not counted to the end.
        limit: how many may be.
        remedy: what to do.
        field: what holds them, as on the wire; None for a body of points.
    """

    def __init__(
        self, count: int | str, limit: int, remedy: str = "crop or downsample it", field: str | None = None
    ) -> None:
        shown = f"over {_MOST_SHOWN}" if isinstance(count, int) and count > _MOST_SHOWN else count
        super().__init__(f"The cloud has {shown} points (limit {limit}); {remedy}.")
        self.count = count
        self.limit = limit
        self.field = field


class WeightsError(TesnetError):
    """A weights file cannot be used.

    Args:
        path: the file.
        why: what is wrong with it and what to do.
    """

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(f"{path}: {why}")
        self.path = Path(path)
        self.why = why


class DeviceError(TesnetError):
    """The compute device asked for does not exist on this machine."""


class GaveUp(TesnetError):
    """A prediction was left unfinished, as its caller's `give_up` asked."""

    def __init__(self) -> None:
        super().__init__("The prediction was given up: nobody waits for it any more; ask again with more time.")
