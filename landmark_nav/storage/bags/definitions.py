"""Message definitions of a bag, and deserialisation of its messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.factory import default_typestore
from landmark_nav.storage.bags.container import ChannelInfo

# Name of a type in ROS 1 -> its name in ROS 2.
STANDARD_NAMES = {'tf/msg/tfMessage': 'tf2_msgs/msg/TFMessage'}

# Greatest length and number of fields of a definition; real ones have some ten thousand at most.
_MAX_CHARACTERS, _MAX_FIELDS = 200_000, 100_000
# Field of messages without content.
_FILLER = 'structure_needs_at_least_one_member'


class MessageReader:
    """
    Deserialises the messages of one channel, or converts them to the serialisation of ROS 2.

    A standard type is read by its ROS 2 definition. The definition in the bag must agree with it,
    but names of fields may have capitals as in ROS 1. Any other type is read by the definition in
    the bag.

    Raises `LandmarkNavError`: the definition is missing or damaged, contains itself, has too many
    fields, or differs from the one of ROS 2.
    """

    def __init__(self, info: ChannelInfo) -> None:
        """Check the definition."""
        self.type_name = STANDARD_NAMES.get(info.type_name, info.type_name)
        self._ros1 = info.message_encoding == 'ros1'
        if not self._ros1 and (
            info.message_encoding != 'cdr'
            or info.schema_encoding not in ('ros2msg', 'ros2idl', 'omgidl', '')
        ):
            raise LandmarkNavError(
                f'it is written as {info.message_encoding or "nothing"} with '
                f'{info.schema_encoding or "no"} schema, not as cdr with ros2msg: record it with '
                'ros2 bag'
            )
        self._info = info
        standard = default_typestore()
        ours = {name: entry[1] for name, entry in standard.fielddefs.items()}
        known = self.type_name in ours
        if known and not info.schema:
            self._store: Typestore = standard
            return
        try:
            defined = _parsed(info)
            # Definitions of ROS 1 do not include built-in types such as time.
            fields = ours | {name: entry[1] for name, entry in defined.items()}
            if self._ros1:
                # The first field, which ROS 2 does not have, is dropped by the conversion.
                name = 'std_msgs/msg/Header'
                fields[name] = [field for field in fields[name] if field[0] != 'seq']
            _size(fields, info.type_name, ())
            if not known:
                self._store = get_typestore(Stores.EMPTY)
                self._store.register(defined)
                return
        except LandmarkNavError:
            raise
        except (Exception, RecursionError) as error:
            # The message of the parser is left out: it repeats the whole definition.
            raise LandmarkNavError(
                f'the definition of {info.type_name} in the bag is missing or damaged: '
                'record it again'
            ) from error
        self._store = standard
        if difference := _difference(fields, ours, info.type_name, self.type_name):
            raise LandmarkNavError(
                f'its {info.type_name} differs from the one of ROS 2 ({difference}): record it '
                'with the standard messages'
            )

    def serialized(self, data: bytes | memoryview) -> bytes | memoryview:
        """Return a message in the serialisation of ROS 2 (CDR)."""
        return self._store.ros1_to_cdr(data, self.type_name) if self._ros1 else data

    def message(self, data: bytes | memoryview) -> Any:
        """Return a message from its bytes in the serialisation of ROS 2 (CDR)."""
        return self._store.deserialize_cdr(data, self.type_name)


def has_header(type_name: str) -> bool:
    """Whether messages of a standard type begin with a header; false for other types."""
    _, fields = default_typestore().fielddefs.get(type_name, ([], []))
    return bool(fields) and fields[0][1] == (Nodetype.NAME, 'std_msgs/msg/Header')


def _parsed(info: ChannelInfo) -> dict[str, Any]:
    if len(info.schema) > _MAX_CHARACTERS:
        raise ValueError('too long')
    if info.schema_encoding in ('ros2msg', ''):
        return get_types_from_msg(info.schema, info.type_name)
    types: dict[str, Any] = {}
    # Such lines separate the definitions of several files.
    for part in info.schema.split('=' * 80 + '\n'):
        text = part.split('\n', 1)[1] if part.startswith('IDL: ') else part
        types |= get_types_from_idl(text) if text.strip() else {}
    return types


def _size(fields: Mapping[str, Any], name: str, inside: tuple[str, ...]) -> int:
    """Number of fields of a message, including those of its parts; recursion is refused."""
    if name in inside:
        raise LandmarkNavError(
            f'the definition of {name} in the bag contains itself: record it again'
        )
    total = 0
    for _, description in fields[name]:
        count, element = 1, description
        if element[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            element, length = element[1]
            count = length if description[0] == Nodetype.ARRAY else 1
        within = _size(fields, element[1], (*inside, name)) if element[0] == Nodetype.NAME else 1
        # An element without content counts too, as a sequence of it could have any length.
        total += count * max(within, 1)
        if total > _MAX_FIELDS:
            raise LandmarkNavError(
                f'the definition of {name} in the bag has over {_MAX_FIELDS} elements: no message '
                'is as large, record it again'
            )
    return total


def _difference(
    theirs: Mapping[str, Any], ours: Mapping[str, Any], their_type: str, our_type: str
) -> str:
    """First difference of the fields of a type; empty if there is none."""
    found, expected = (
        [(field.lower(), kind) for field, kind in fields if field != _FILLER]
        for fields in (theirs[their_type], ours[our_type])
    )
    for k, (field, kind) in enumerate(expected):
        if k >= len(found) or found[k][0] != field:
            return f'{field} of {our_type} is missing or at another place'
        if _words(found[k][1]) != _words(kind):
            return f'{field} is {_words(found[k][1])}, not {_words(kind)}'
        element = kind[1][0] if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else kind
        inner = element[1] if element[0] == Nodetype.NAME else None
        if inner and (difference := _difference(theirs, ours, inner, inner)):
            return difference
    if len(found) > len(expected):
        return f'{found[len(expected)][0]} is not a field of {our_type}'
    return ''


def _words(description: Any) -> str:
    """Type of a field as a definition writes it, without bounds, which are not serialised."""
    kind, content = description
    if kind == Nodetype.BASE:
        return str(content[0])
    if kind == Nodetype.NAME:
        return str(content)
    element, length = content
    return f'{_words(element)}[{length if kind == Nodetype.ARRAY else ""}]'
