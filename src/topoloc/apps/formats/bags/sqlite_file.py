"""Read ROS 2 bags in SQLite (``.db3``): one row for each message. Of a database that is cut off,
the rows before are read.

Incremental blobs of SQLite read the first bytes of a message without the pages of an image.
"""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass, field
from pathlib import Path

from topoloc import RecordingError
from topoloc.apps.formats.bags.bag import MessageRef, Topic, damaged_message_error

_ROW = -2  # in place of a chunk's number
# UnicodeDecodeError: the text of an error quotes damaged data
_DAMAGE_ERRORS = (sqlite3.Error, UnicodeDecodeError)


@dataclass(eq=False)
class SqliteFile:
    """The database of a ROS 2 bag."""

    path: Path
    topics: dict[str, Topic] = field(default_factory=dict)
    fault: str | None = None
    _numbers: dict[str, list[int]] = field(default_factory=dict)
    _database: sqlite3.Connection = field(init=False)

    def __post_init__(self) -> None:
        uri = f"{self.path.resolve().as_uri()}?mode=ro"
        try:
            self._database = sqlite3.connect(uri, uri=True, check_same_thread=False)
            self._database.text_factory = lambda data: data.decode(errors="replace")
            self._database.execute("PRAGMA trusted_schema = OFF")
            if self._is_cut():
                # Without this switch SQLite refuses a file that is shorter than in its header.
                # Nothing is written.
                self._database.execute("PRAGMA writable_schema = ON")
            select = "SELECT id, name, type, serialization_format FROM topics"
            rows = self._database.execute(select).fetchall()
        except _DAMAGE_ERRORS as error:
            why = " ".join(str(error).split())[:120]
            raise RecordingError(
                f"{self.path}: not a ROS 2 bag, or damaged at its beginning ({why})"
            ) from None
        for number, name, kind, encoding in rows:
            texts = (name, kind, encoding)
            if isinstance(number, int) and all(isinstance(text, str) for text in texts):
                self.topics.setdefault(name, Topic(name, kind, encoding))
                self._numbers.setdefault(name, []).append(number)

    def messages(self, topic: str) -> list[MessageRef]:
        """Return the messages of a topic in the order in which they were written."""
        refs: list[MessageRef] = []
        for number in self._numbers[topic]:
            try:
                select = "SELECT id, timestamp FROM messages WHERE topic_id = ?"
                for row, t_ns in self._database.execute(select, (number,)):
                    if isinstance(row, int) and isinstance(t_ns, int):
                        refs.append(MessageRef(t_ns, _ROW, row))
            except _DAMAGE_ERRORS as error:
                self.fault = self.fault or f"damaged ({' '.join(str(error).split())[:120]})"
        refs.sort()
        while self.fault and refs and not self._is_whole(refs[-1]):
            refs.pop()
        return refs

    def read(self, ref: MessageRef, most: int | None = None) -> bytes:
        """Return the bytes of a message, or the first `most` of them. Raises RecordingError."""
        try:
            with self._database.blobopen("messages", "data", ref.offset, readonly=True) as blob:
                return blob.read(-1 if most is None else most)
        except (ValueError, *_DAMAGE_ERRORS):
            raise damaged_message_error(self.path.name, ref) from None

    def _is_whole(self, ref: MessageRef) -> bool:
        try:
            return bool(self.read(ref))
        except RecordingError:
            return False

    def _is_cut(self) -> bool:
        """Return whether the header gives more pages than the file has, and store this as the
        fault."""
        with self.path.open("rb") as file:
            header = file.read(32)
        page_size, size = int.from_bytes(header[16:18], "big"), self.path.stat().st_size
        page_size = 65536 if page_size == 1 else page_size
        is_cut = int.from_bytes(header[28:32], "big") * page_size > size
        if is_cut:
            self.fault = f"cut off after {size / 1e6:.3f} MB"
        return is_cut
