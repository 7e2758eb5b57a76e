from __future__ import annotations

import gzip
import tracemalloc
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from client.answer_body import AnswerBody, UnusableBody

MB = 2**20


def fed(encoding: str, limit: int, body: bytes, size: int = 1000) -> bytes:
    """The content of a body that comes in chunks of a size."""
    collected = AnswerBody(encoding, limit)
    for begin in range(0, len(body), size):
        collected.add(body[begin : begin + size])
    return collected.content()


@given(
    body=st.binary(max_size=5000), size=st.integers(1, 700), encoding=st.sampled_from(["", "identity", "gzip", " GZip"])
)
@settings(max_examples=40, deadline=None)
def test_what_went_in_comes_out_however_it_is_cut_and_packed(body: bytes, size: int, encoding: str) -> None:
    sent = gzip.compress(body) if "zip" in encoding.lower() else body
    assert fed(encoding, len(body), sent, size) == body
    if body:
        with pytest.raises(UnusableBody, match="raise `max_answer_mb`"):
            fed(encoding, len(body) - 1, sent, size)


def test_a_bomb_is_refused_before_it_has_grown() -> None:
    pack = zlib.compressobj(9, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    bomb = b"".join(pack.compress(bytes(MB)) for _ in range(256)) + pack.flush()
    assert len(bomb) < MB
    tracemalloc.start()
    try:
        with pytest.raises(UnusableBody, match="over 1 MB"):
            fed("gzip", MB, bomb, len(bomb))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 16 * MB


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"{}", "is no gzip"),
        (b"", "in the middle"),
        (gzip.compress(b"{}" * 100, mtime=0)[:-9], "in the middle"),
        (gzip.compress(b"{}", mtime=0) + bytes(2000), "goes on after"),
    ],
)
def test_a_damaged_gzip_is_told(body: bytes, words: str) -> None:
    with pytest.raises(UnusableBody, match=words):
        fed("gzip", MB, body)


def test_an_encoding_that_was_not_asked_for_is_named() -> None:
    with pytest.raises(UnusableBody, match="'br'; `gzip` or none"):
        AnswerBody("br", MB)
