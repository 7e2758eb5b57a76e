from __future__ import annotations

import inspect
import re

from tesnet import errors


def test_the_tree_in_the_documentation_is_the_tree_of_classes() -> None:
    drawn = set(re.findall(r"^ *\+-- (\w+)", errors.__doc__ or "", re.MULTILINE))
    classes = {
        name: kind for name, kind in inspect.getmembers(errors, inspect.isclass) if kind.__module__ == "tesnet.errors"
    }
    assert drawn | {"TesnetError"} == set(classes)
    assert all(issubclass(kind, errors.TesnetError) for kind in classes.values())


def test_errors_carry_what_a_caller_decides_by() -> None:
    refused = errors.InvalidQuery("viewpoint", "has 0 positions; give 1 to 64")
    assert (refused.field, refused.message) == ("viewpoint", "has 0 positions; give 1 to 64")
    assert str(refused) == "viewpoint: has 0 positions; give 1 to 64"
    large = errors.TooManyPoints(7, 5)
    assert (large.count, large.limit) == (7, 5)
    assert str(large) == "The cloud has 7 points (limit 5); crop or downsample it."
    assert large.field is None
