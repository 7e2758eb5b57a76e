"""A form, read back by a reader that is not ours."""

from __future__ import annotations

from email import message_from_bytes
from email.message import EmailMessage, Message
from email.policy import HTTP

from hypothesis import given
from hypothesis import strategies as st

from client.form import File, encode_form

names = st.from_regex(r"[a-z_]{1,12}", fullmatch=True)
files = st.builds(File, name=names, file_name=st.none() | names, content=st.binary(max_size=200))


@given(st.lists(files, min_size=1, max_size=5))
def test_parts_come_out_as_they_went_in(parts: list[File]) -> None:
    content_type, body = encode_form(parts)
    message = message_from_bytes(f"Content-Type: {content_type}\r\n\r\n".encode() + body, policy=HTTP)
    assert isinstance(message, EmailMessage)
    assert message.get_content_type() == "multipart/form-data"
    assert [described(part) for part in message.iter_parts()] == [
        (part.name, part.file_name, part.content_type, part.content) for part in parts
    ]


def described(part: Message) -> tuple[object, ...]:
    """Name, file name, type and content of a part, as Python's reader of e-mail understands it."""
    disposition = "content-disposition"
    name, file_name = part.get_param("name", header=disposition), part.get_param("filename", header=disposition)
    return name, file_name, part.get_content_type(), part.get_payload(decode=True)
