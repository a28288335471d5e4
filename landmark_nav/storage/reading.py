"""Checked reading of files and fields: bounded size, UTF-8 text, YAML with plain values."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
import difflib
from pathlib import Path
import re
import stat
from typing import Any

import cv2
import numpy as np
import yaml

from landmark_nav.arrays import ImageArray
from landmark_nav.errors import inside, LandmarkNavError, shown, why
from landmark_nav.image_codec import decode_image, MAX_PIXELS
from landmark_nav.types import FloatArray

# Greatest size of a file; the largest map has a few megabytes.
_MAX_BYTES = 32_000_000
# Greatest number of nodes of a document (that of a map of 3,000 landmarks), and greatest depth.
_MAX_NODES, _MAX_DEPTH = 500_000, 40
# Greatest length of a plain scalar that is parsed as a number; longer ones are text.
_MAX_NUMBER_LENGTH = 64

# The loader of libyaml, if PyYAML has it, is ten times as fast.
_LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
_RESOLVERS: dict[str, list[tuple[str, re.Pattern[str]]]] = yaml.SafeLoader.yaml_implicit_resolvers
_CONSTRUCTOR = yaml.constructor.SafeConstructor()
_TAG = 'tag:yaml.org,2002:'
_CONSTRUCT = {
    f'{_TAG}int': _CONSTRUCTOR.construct_yaml_int,
    f'{_TAG}float': _CONSTRUCTOR.construct_yaml_float,
    f'{_TAG}bool': _CONSTRUCTOR.construct_yaml_bool,
    f'{_TAG}null': _CONSTRUCTOR.construct_yaml_null,
}
# YAML 1.2 and JSON write 1e-3, which PyYAML (YAML 1.1) takes for text.
_EXPONENT = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+')
_ABSENT = object()
# Kind of a file -> key at its top level that others lack.
_KEY_OF_KIND = {'robot': 'pan_axis', 'room': 'walls'}


def check_regular(path: Path) -> int:
    """
    Return the size of a file in bytes.

    Raises `LandmarkNavError`: the file does not exist, or is a folder, a pipe, a socket or a
    device, whose content may be endless.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        raise LandmarkNavError(f'{path}: cannot be read: {why(error)}') from error
    if not stat.S_ISREG(status.st_mode):
        kind = 'a folder' if stat.S_ISDIR(status.st_mode) else 'a pipe, socket or device'
        raise LandmarkNavError(f'{path}: is {kind}: give a file')
    return status.st_size


def read_bytes(path: Path, max_bytes: int = _MAX_BYTES) -> bytes:
    """
    Return the content of a file.

    Raises `LandmarkNavError`: it is not a regular file, has more than `max_bytes`, or cannot be
    read.
    """
    size = check_regular(path)
    if size > max_bytes:
        raise LandmarkNavError(
            f'{path}: {size / 1e6:.0f} MB, more than {max_bytes / 1e6:g} MB: is it the right file?'
        )
    try:
        with path.open('rb') as stream:
            return stream.read(max_bytes)
    except OSError as error:
        raise LandmarkNavError(f'{path}: cannot be read: {why(error)}') from error


def read_image(
    path: Path, mode: int = cv2.IMREAD_COLOR, max_pixels: int = MAX_PIXELS
) -> ImageArray:
    """
    Return the 8-bit pixels of a PNG or JPEG file, see `decode_image`.

    Raises `LandmarkNavError`: as `read_bytes`, or the file is not such an image, or has more than
    `max_pixels`.
    """
    data = read_bytes(path)
    with inside(path):
        return np.asarray(decode_image(data, mode, max_pixels), dtype=np.uint8)


def read_text(path: Path, max_bytes: int = _MAX_BYTES) -> str:
    """
    Return the text of a UTF-8 file, with or without byte order mark.

    Raises `LandmarkNavError`: as `read_bytes`, or the file is not UTF-8.
    """
    data = read_bytes(path, max_bytes)
    try:
        return data.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        line = data.count(b'\n', 0, error.start) + 1
        raise LandmarkNavError(f'{path}: line {line}: not UTF-8 text: save it as UTF-8') from error


def read_yaml_mapping(path: Path, kind: str = '') -> dict[str, Any]:
    """
    Return the top-level mapping of a YAML file; it is empty if the file is.

    If a `kind` is given (robot, room, config), a file of another one is refused.

    Values follow YAML 1.1; numbers may also be written as in JSON. Dates are text. Tags and
    aliases are refused.

    Raises `LandmarkNavError`: the file cannot be read, is not such YAML, or exceeds the bounds of
    this module.
    """
    text = read_text(path)
    try:
        document = _document(yaml.parse(text, Loader=_LOADER))
    except yaml.MarkedYAMLError as error:
        mark, what = error.problem_mark, error.problem
        if mark is not None and text[mark.index : mark.index + 1] == '\t':
            what = 'a tab: indent with spaces'
        line = '' if mark is None else f'line {mark.line + 1}: '
        raise LandmarkNavError(f'{path}: not YAML: {line}{what}') from error
    except yaml.YAMLError as error:
        raise LandmarkNavError(f'{path}: not YAML: {" ".join(str(error).split())}') from error
    except LandmarkNavError as error:
        raise LandmarkNavError(f'{path}: {error}') from error
    if not isinstance(document, dict | None):
        raise LandmarkNavError(f'{path}: holds no mapping')
    document = document or {}
    for other, key in _KEY_OF_KIND.items() if kind else ():
        if key in document and _KEY_OF_KIND.get(kind) not in document:
            how = f'give it as --{other} (nodes: {other}_file)'
            raise LandmarkNavError(f'{path}: this is a {other} file: {how}')
    return document


def _document(events: Iterator[yaml.Event]) -> Any:
    """Build the value of the single document, without recursion and with bounded steps."""
    # The constructor of PyYAML follows aliases, whose expansion has no bound, and passes on errors
    # of malformed values with a tag.
    document: Any = None
    # Open containers, each with the key that has no value yet.
    opened: list[tuple[Any, Any]] = []
    nodes = documents = 0
    for event in events:
        value: Any = None
        if isinstance(event, yaml.DocumentStartEvent):
            documents += 1
            if documents > 1:
                raise _refused(event, 'a second document begins: keep one')
        if isinstance(event, yaml.NodeEvent):
            nodes += 1
            if isinstance(event, yaml.AliasEvent):
                raise _refused(event, f'*{event.anchor}: write the value instead of an alias')
            if (tag := getattr(event, 'tag', None)) is not None:
                what = shown(tag.replace(_TAG, '!!'))
                raise _refused(event, f'tag {what}: write the value alone')
            if nodes > _MAX_NODES or len(opened) > _MAX_DEPTH:
                bounds = f'{_MAX_NODES} values or {_MAX_DEPTH} levels'
                raise _refused(event, f'more than {bounds}: is it the right file?')
        if isinstance(event, yaml.SequenceStartEvent | yaml.MappingStartEvent):
            opened.append(([] if isinstance(event, yaml.SequenceStartEvent) else {}, _ABSENT))
            continue
        if isinstance(event, yaml.ScalarEvent):
            value = _scalar(event.value) if event.implicit[0] else event.value
        elif isinstance(event, yaml.SequenceEndEvent | yaml.MappingEndEvent):
            value, _ = opened.pop()
        else:
            continue
        if not opened:
            document = value
            continue
        container, key = opened[-1]
        if isinstance(container, list):
            container.append(value)
        elif key is not _ABSENT:
            container[key] = value
            opened[-1] = container, _ABSENT
        elif isinstance(value, dict | list):
            raise _refused(event, f'{shown(value)} is no name of a value')
        elif value in container:
            raise _refused(event, f'{shown(value)} is there twice: keep one')
        else:
            opened[-1] = container, value
    return document


def _refused(event: yaml.Event, what: str) -> LandmarkNavError:
    mark = event.start_mark
    return LandmarkNavError(what if mark is None else f'line {mark.line + 1}: {what}')


def _scalar(text: str) -> Any:
    """Value of a plain scalar: a number, a Boolean, None, or text."""
    if len(text) <= _MAX_NUMBER_LENGTH:
        for tag, pattern in _RESOLVERS.get(text[:1], ()):
            if tag in _CONSTRUCT and pattern.match(text):
                try:
                    return _CONSTRUCT[tag](yaml.ScalarNode(tag, text))
                except ValueError:  # such as `0x_`, which matches the pattern of a number
                    return text
        if _EXPONENT.fullmatch(text):
            return float(text)
    return text


# Greatest negative eigenvalue and asymmetry of a covariance, relative to its largest eigenvalue.
_ROUNDING = 1e-9
# Least similarity (`difflib`) at which an unknown name is a misspelt known one, and a misspelt
# required one that is missing.
_ALIKE, _ALIKE_MISSING = 0.8, 0.6
# Greatest number of unknown fields that are compared, which takes long. With more, the file is
# of another kind.
_MOST_COMPARED = 100
_MAX_NAME_LENGTH = 100
# Greatest length, angle or variance; squares of larger numbers might overflow.
_LARGEST = 1e12


class Entry:
    """
    A mapping out of a file; its fields are checked when they are read.

    Errors begin with `where`. A key that resembles one of the `known` ones which are absent is
    misspelt; other unknown keys are allowed.

    Raises `LandmarkNavError`: it is not a mapping, or a key is misspelt. The methods: a field is
    missing, or is not what they return.
    """

    def __init__(self, mapping: Any, where: str, known: Collection[str] = ()) -> None:
        if not isinstance(mapping, Mapping):
            raise LandmarkNavError(f'{where} is {shown(mapping)}, not a mapping')
        self._mapping, self.where = mapping, where
        absent = [key for key in known if key not in mapping]
        strange = [key for key in mapping if key not in known and len(str(key)) < _MAX_NAME_LENGTH]
        self._strange = strange[:_MOST_COMPARED] if known else []
        self._check_spelling(absent, _ALIKE)

    def _check_spelling(self, absent: list[str], alike: float) -> None:
        for key in self._strange if absent else ():
            if meant := difflib.get_close_matches(str(key), absent, 1, alike):
                raise self.refused(f'{key} is no field: write {meant[0]}')

    def __contains__(self, key: str) -> bool:
        return key in self._mapping

    def refused(self, why: str) -> LandmarkNavError:
        """Error of this mapping."""
        return LandmarkNavError(f'{self.where}: {why}')

    def field(self, key: str) -> Any:
        """Value of `key`, of any kind."""
        if key not in self._mapping:
            self._check_spelling([key], _ALIKE_MISSING)
            raise self.refused(f'{key} is missing')
        return self._mapping[key]

    def list_of(self, key: str, longest: int | None = None) -> list[Any]:
        """Value of `key`, a list of at most `longest` items."""
        value = self.field(key)
        if not isinstance(value, list):
            raise self.refused(f'{key} is {shown(value)}, not a list')
        if longest is not None and len(value) > longest:
            raise self.refused(f'{key} has {len(value)} entries: {longest} at most')
        return value

    def entries(
        self, key: str, known: Collection[str] = (), longest: int | None = None
    ) -> list[Entry]:
        """Mappings in the list of `key`."""
        values = enumerate(self.list_of(key, longest))
        return [Entry(value, f'{self.where}: {key}[{k}]', known) for k, value in values]

    def section(self, key: str, known: Collection[str] = ()) -> Entry:
        """Mapping of `key`, whose errors begin with that."""
        return Entry(self.field(key), key, known)

    def name(self, key: str, default: str | None = None, *, blank: bool = False) -> str:
        """Value of `key`, a word or an integer; `default`, if given, for a key that is absent."""
        if default is not None and key not in self:
            return default
        value = self.field(key)
        name = str(value)
        word = isinstance(value, str | int) and not isinstance(value, bool)
        fits = (blank or name) and len(name) <= _MAX_NAME_LENGTH and name.isprintable()
        if not (word and fits):
            raise self.refused(f'{key} is {shown(value)}, not a name')
        return name

    def integer(self, key: str) -> int:
        """Value of `key`, a non-negative integer."""
        value = self.field(key)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**63:
            raise self.refused(f'{key} is {shown(value)}, not an integer from 0 on')
        return value

    def number(
        self, key: str, low: float = -_LARGEST, high: float = _LARGEST, how: str = ''
    ) -> float:
        """Value of `key`, a number, see `array`."""
        return float(self.array(key, (), low, high, how))

    def array(
        self,
        key: str,
        shape: tuple[int | None, ...],
        low: float = -_LARGEST,
        high: float = _LARGEST,
        how: str = '',
    ) -> FloatArray:
        """
        Value of `key`, an array of finite numbers; None in `shape` stands for any length.

        Numbers are from `low` to `high`, or the error says `how` they should be.
        """
        value = self.field(key)
        wanted = ' x '.join('n' if length is None else str(length) for length in shape)
        what = f'{key} is {shown(value)}'
        kind = f'not {wanted} numbers' if shape else 'not a number'
        try:
            array = np.asarray(value)
        except (ValueError, OverflowError) as error:
            raise self.refused(f'{what}, {kind}') from error
        fits = array.ndim == len(shape) and all(
            wanted in (None, length) for wanted, length in zip(shape, array.shape, strict=True)
        )
        if not fits or (array.dtype.kind not in 'iuf' and array.size) or _holds_boolean(value):
            raise self.refused(f'{what}, {kind}')
        numbers = array.astype(np.float64)
        if not np.all(np.isfinite(numbers)):
            raise self.refused(f'{what}: not finite')
        if np.any(np.abs(numbers) > _LARGEST):
            raise self.refused(f'{what}: larger than {_LARGEST:g}')
        if np.any((numbers < low) | (numbers > high)):
            raise self.refused(f'{what}: {how}')
        return numbers

    def covariance(self, size: int) -> FloatArray:
        """Value of ``covariance``, a covariance matrix (size, size)."""
        matrix = self.array('covariance', (size, size))
        eigenvalues = np.linalg.eigvalsh(matrix)
        slack = _ROUNDING * max(float(eigenvalues[-1]), 0.0)
        if np.abs(matrix - matrix.T).max() > slack or eigenvalues[0] < -slack:
            raise self.refused('no covariance: not symmetric, or negative eigenvalues')
        return matrix


def _holds_boolean(value: Any) -> bool:
    """Whether a yes or no is among numbers, where NumPy takes it for 1 or 0."""
    return any(map(_holds_boolean, value)) if isinstance(value, list) else isinstance(value, bool)
