"""Hostile inputs: bytes that are changed, values that are odd, messages with such values."""

import struct
from typing import Any

from hypothesis import strategies as st
import numpy as np
from rosbags.interfaces import Nodetype

from landmark_nav.messages.factory import default_typestore

__all__ = ['changed_bytes', 'changed_message', 'changed_yaml']

# A new store compiles its serialisers anew.
_STORE = default_typestore()
_WORDS = (
    b'!!int zz', b'!!float x', b'!!bool 7', b'!!timestamp q', b'!!python/object:os.system',
    b'&a [*a]', b'&a', b'*a', b'<<: *a', b'9' * 400, b'1e400', b'-1', b'0', b'.nan', b'-.inf',
    b'nan', b'1e-320', b'~', b'[]', b'{}', b'[' * 3000, b'"', b"'", b'\x00', b'\t', b'\r', b'\xff',
    b'\xef\xbb\xbf', b'|', b'? ', b'- ', b': ', b'%', b'2026-01-01', b'0x7fffffffffffffff', b'1_0',
)  # fmt: skip


@st.composite
def changed_bytes(draw, valid, most=8):
    """Bytes of a valid file with up to `most` changes, or cut off."""
    data = bytearray(valid)
    for _ in range(draw(st.integers(1, most))):
        at = draw(st.integers(0, max(0, len(data) - 1)))
        span = draw(st.sampled_from((0, 1, 2, 4, 8, 64)))
        kind = draw(st.sampled_from(('word', 'bytes', 'cut', 'repeat', 'integer')))
        if kind == 'word':
            data[at : at + span] = draw(st.sampled_from(_WORDS))
        elif kind == 'bytes':
            data[at : at + span] = draw(st.binary(max_size=16))
        elif kind == 'cut':
            del data[at : at + 16 * span]
        elif kind == 'repeat':
            data[at:at] = data[at : at + 16 * span] * draw(st.integers(1, 8))
        else:
            value = draw(st.sampled_from((0, 1, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1)))
            size = draw(st.sampled_from((1, 2, 4, 8)))
            data[at : at + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, 'little')
    return bytes(data)


_ODD: tuple[Any, ...] = (
    None, True, '', 'x', 'x' * 5000, '\x1b[31m\n', 0, -1, 1e9, 1e300, -1e300, 1e-300, 10**400,
    float('nan'), float('inf'), [], {}, [[]], [1.0, 2.0], [0.0] * 3, [float('nan')] * 3,
    [[0.0, 0.0], [0.0, 0.0]], {'x': 1}, {1: 2},
    'map', 57.3, -57.3, 0.5, 100.0, 2**31, 2**63,
)  # fmt: skip


@st.composite
def changed_yaml(draw, valid, most=3):
    """Document with up to `most` of its values replaced, removed or doubled."""
    document = _copied(valid)
    for _ in range(draw(st.integers(1, most))):
        holder = document
        while True:
            keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
            if not keys:
                break
            key = draw(st.sampled_from(keys))
            if isinstance(holder[key], dict | list) and draw(st.booleans()):
                holder = holder[key]
                continue
            kind = draw(st.sampled_from(('odd', 'odd', 'scaled', 'removed', 'added')))
            if kind == 'removed':
                del holder[key]
            elif kind == 'scaled' and isinstance(holder[key], int | float):
                scale = draw(st.sampled_from((-1, 0.001, 10, 1000, 57.3)))
                # Whole numbers beyond a float stay whole.
                holder[key] *= scale if abs(holder[key]) < 1e300 else round(scale)
            elif kind == 'added' and isinstance(holder, list):
                holder.append(holder[key])
            elif kind == 'added':
                holder['odd'] = _copied(draw(st.sampled_from(_ODD)))
            else:
                holder[key] = _copied(draw(st.sampled_from(_ODD)))
            break
    return document


def _copied(value):
    if isinstance(value, dict):
        return {key: _copied(entry) for key, entry in value.items()}
    return [_copied(entry) for entry in value] if isinstance(value, list) else value


_TEXTS = ('', 'map', 'odom', 'base_link', '/x', 'pan_joint', 'mono8', 'bgr8', 'é' * 300, '\n')
_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e-9, 3.2, 100.0, 1e9, 1e19, 1e100, 1.7e308)
_BAD_FLOATS = (float('nan'), float('inf'), float('-inf'))


@st.composite
def changed_message(draw, type_name, valid, most=3):
    """Copy of a message, in rosbags' form, with up to `most` fields replaced; values fit types."""
    message = _as_rosbags(type_name, valid)
    for _ in range(draw(st.integers(1, most))):
        _change(draw, type_name, message)
    return message


def _as_rosbags(type_name, message):
    """Copy of a message in rosbags' own, mutable, form."""
    fields = _STORE.fielddefs[type_name][1]
    copied = {name: _copied_field(kind, getattr(message, name)) for name, kind in fields}
    return _Message(type_name, copied)


class _Message:
    """A message whose fields can be replaced."""

    def __init__(self, type_name, fields):
        self.type_name = type_name
        self.__dict__.update(fields)


def _copied_field(description, value):
    kind, content = description
    if kind == Nodetype.NAME:
        return _as_rosbags(content, value)
    if kind == Nodetype.BASE:
        return value
    element = content[0]
    if element[0] == Nodetype.BASE and element[1][0] != 'string':
        return np.array(value, dtype=_dtype(element[1][0]))
    return [_copied_field(element, entry) for entry in value]


def _dtype(name):
    return np.dtype({'bool': 'bool', 'byte': 'u1', 'char': 'u1'}.get(name, name))


def _change(draw, type_name, message):
    name, description = draw(st.sampled_from(_STORE.fielddefs[type_name][1]))
    kind, content = description
    value = getattr(message, name)
    if kind == Nodetype.NAME:
        _change(draw, content, value)
    elif kind == Nodetype.BASE:
        setattr(message, name, draw(_scalar(content[0])))
    else:
        setattr(message, name, _changed_array(draw, content[0], value, kind == Nodetype.ARRAY))


def _changed_array(draw, element, value, fixed):
    kinds = ('entry', 'entry', 'fill') if fixed else ('entry', 'fill', 'length')
    what, count = draw(st.sampled_from(kinds)), len(value)
    if what == 'length':
        length = draw(st.sampled_from((0, 1, count // 2, max(0, count - 1), 2 * count)))
        return np.resize(value, length) if isinstance(value, np.ndarray) else (2 * value)[:length]
    if not len(value):
        return value
    at = draw(st.integers(0, len(value) - 1))
    if element[0] == Nodetype.NAME:
        _change(draw, element[1], value[at])
        return value
    odd = draw(_scalar(element[1][0]))
    if isinstance(value, np.ndarray) and what == 'fill':
        value[:] = odd
    elif isinstance(value, np.ndarray) and value.dtype == np.uint8:
        # Bytes that hold numbers: a run of them is one.
        run = draw(
            st.one_of(
                st.binary(max_size=16), st.sampled_from(_BAD_FLOATS).map(struct.Struct('<d').pack)
            )
        )
        run = run[: len(value) - at]
        value[at : at + len(run)] = np.frombuffer(run, np.uint8)
    else:
        value[at] = odd
    return value


def _scalar(name):
    if name == 'string':
        return st.one_of(st.sampled_from(_TEXTS), st.text(max_size=12))
    dtype = _dtype(name)
    if dtype.kind == 'b':
        return st.booleans()
    if dtype.kind == 'f':
        width = 32 if dtype.itemsize == 4 else 64
        numbers = [float(np.float32(v)) if width == 32 and v < 3e38 else v for v in _FLOATS]
        fitting = [v for v in numbers if width == 64 or abs(v) < 3e38]
        return st.one_of(st.sampled_from([*fitting, *_BAD_FLOATS]), st.floats(width=width))
    limits = np.iinfo(dtype)
    ends = [v for v in (0, 1, 2, 3, 7, 255, 65535) if v <= limits.max]
    ends += [int(limits.min), int(limits.max)]
    return st.one_of(st.sampled_from(ends), st.integers(int(limits.min), int(limits.max)))
