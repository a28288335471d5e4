"""Topics of the contract in a bag, message definitions, and deserialisation of messages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.factory import default_typestore
from landmark_nav.storage.bags.container import ChannelInfo

# Latched topics: a later subscriber receives the last message.
MAP_TOPICS = ('landmarks', 'landmarks/atlas', 'landmarks/markers')

# Images of a drive and of sweeps, in the order in which they are looked for.
DRIVE_IMAGES = ('camera/image_raw', 'camera/image_raw/compressed')
SWEEP_IMAGES = ('sweep/image', 'sweep/image/compressed')
# Images of one kind of recording -> those of the other kind, its name, and what is wanted.
OTHER_KIND: dict[tuple[str, ...], tuple[tuple[str, ...], str, str]] = {
    DRIVE_IMAGES: (SWEEP_IMAGES, 'sweeps', 'a drive, such as bags/drive'),
    SWEEP_IMAGES: (DRIVE_IMAGES, 'a drive', 'sweeps, such as bags/learn'),
}

# Greatest number of names in a message.
_MOST_NAMES = 5

# Type -> topics.
_BY_TYPE = {
    'sensor_msgs/msg/Image': 'camera/image_raw sweep/image panorama/image landmarks/atlas',
    'sensor_msgs/msg/CompressedImage': 'camera/image_raw/compressed sweep/image/compressed '
    'triangulation_localizer/debug_image/compressed',
    'sensor_msgs/msg/CameraInfo': 'camera/camera_info sweep/camera_info panorama/camera_info',
    'sensor_msgs/msg/JointState': 'joint_states',
    'sensor_msgs/msg/PointCloud2': 'landmarks triplet detections global_localization/pose '
    'expectation',
    'nav_msgs/msg/Odometry': 'odom ground_truth/odom odometry/fused',
    'nav_msgs/msg/Path': 'odometry_fusion/path odometry_fusion/odometry_path',
    'trajectory_msgs/msg/JointTrajectory': 'pan_tilt/command sweep/trajectory',
    'geometry_msgs/msg/PoseWithCovarianceStamped': 'sweep/pose panorama/pose triangulation/pose '
    'initialpose odometry_fusion/protection_level',
    'geometry_msgs/msg/Twist': 'cmd_vel',
    'visualization_msgs/msg/MarkerArray': 'landmarks/markers odometry_fusion/markers '
    'triangulation_localizer/markers',
    'tf2_msgs/msg/TFMessage': 'tf tf_static',
}
TOPIC_TYPES = {topic: kind for kind, topics in _BY_TYPE.items() for topic in topics.split()}


def relative_name(topic: str) -> str:
    """
    Return the longest name in the contract that a topic ends with; else the topic itself.

    ``/robot1/odom`` is ``odom``, ``/ground_truth/odom`` is not.
    """
    topic = normal_topic(topic)
    ends = [name for name in TOPIC_TYPES if topic.endswith('/' + name)]
    return max(ends, key=len) if ends else topic[1:]


def listed(names: Iterable[str]) -> str:
    """Names in a line; of many only the first."""
    ordered = sorted(names)
    more = f' and {len(ordered) - _MOST_NAMES} more' if len(ordered) > _MOST_NAMES else ''
    return ', '.join(ordered[:_MOST_NAMES]) + more


def normal_topic(topic: str) -> str:
    """Absolute topic without repeated or trailing slashes."""
    return '/' + '/'.join(part for part in topic.split('/') if part)


def with_form(name: str, type_name: str) -> str:
    """Name in the contract by the type: images have one name raw, another compressed."""
    base = name.removesuffix('/compressed')
    forms = {
        TOPIC_TYPES[form]: form for form in (base, f'{base}/compressed') if form in TOPIC_TYPES
    }
    return forms.get(type_name, name)


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
            if len(info.schema) > _MAX_CHARACTERS:
                raise ValueError('too long')
            defined: dict[str, Any] = {}
            if info.schema_encoding in ('ros2msg', ''):
                defined = get_types_from_msg(info.schema, info.type_name)
            else:
                # Such lines separate the definitions of several files.
                for part in info.schema.split('=' * 80 + '\n'):
                    text = part.split('\n', 1)[1] if part.startswith('IDL: ') else part
                    defined |= get_types_from_idl(text) if text.strip() else {}
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
        try:
            return self._store.deserialize_cdr(data, self.type_name)
        except SerdeError:
            # `rclpy.serialize_message` adds up to 8 bytes to messages with empty sequences.
            for surplus in (4, 8):
                with suppress(SerdeError):
                    return self._store.deserialize_cdr(data[:-surplus], self.type_name)
            raise


def has_header(type_name: str) -> bool:
    """Whether messages of a standard type begin with a header; false for other types."""
    _, fields = default_typestore().fielddefs.get(type_name, ([], []))
    return bool(fields) and fields[0][1] == (Nodetype.NAME, 'std_msgs/msg/Header')


def _size(fields: Mapping[str, Any], name: str, inside: tuple[str, ...]) -> int:
    """Number of fields of a message, including those of its parts; recursion is refused."""
    if name in inside:
        raise LandmarkNavError(f'the definition of {name} contains itself: record it again')
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
