"""
CDR byte layouts: Imu messages and odometry in whole, and the parts that others consist of.

They come and go at the IMU's rate. Decoding and encoding them here, without message objects, costs
about a microsecond each; the typed path of rclpy costs twenty times that. The layout is plain CDR
(XCDR version 1), little endian: a 4-byte encapsulation header, then the fields in the order of the
message definition, each aligned to its own size counted from the end of that header. Only texts and
sequences have a variable length.

References
----------
OMG, *DDS Interoperability Wire Protocol* 2.5, section 10: encapsulation and CDR.
"""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

LITTLE_ENDIAN = b"\x00\x01\x00\x00"  # CDR_LE, no options
_HEADER = struct.Struct("<2sHiII")  # encapsulation, options, stamp, length of frame_id
_HEADER_SIZE = 16
_STAMP = struct.Struct("<iI")
_COUNT = struct.Struct("<I")
_PADDING = (b"", bytes(3), bytes(2), bytes(1))  # up to a multiple of 4
_IMU_BODY_SIZE = 37 * 8
_ODOMETRY_BODY_COUNT = 7 + 36 + 6 + 36
_LONGEST_FRAME_ID = 1024
_RTPS_PADDING = 3  # a middleware may pad a payload to a multiple of 4 bytes


class ImuFields(NamedTuple):
    """
    The fields of one sensor_msgs/Imu that are used, in the message's own axes (FLU).

    Of each covariance only the first element is here: it is -1 where the quantity is absent.
    """

    stamp_ns: int
    specific_force: tuple[float, float, float]  # m/s²
    angular_rate: tuple[float, float, float]  # rad/s
    frame_id: str = ""
    orientation_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)  # in ENU
    specific_force_cov0: float = 0.0
    angular_rate_cov0: float = 0.0
    orientation_cov0: float = -1.0


class ImuDecoder:
    """
    Decodes serialised sensor_msgs/Imu messages of one publisher.

    The layout depends only on the length of `frame_id`; it is kept while that stays the same, and
    checked against every message.
    """

    def __init__(self) -> None:
        self._layout = struct.Struct("")
        self._name = b""
        self._frame_id = ""

    def decode(self, data: bytes) -> ImuFields:
        """
        Decode one message.

        Parameters
        ----------
        data
            The serialised message with its encapsulation header.

        Returns
        -------
        ImuFields

        Raises
        ------
        ValueError
            `data` is no little-endian CDR Imu (other byte order, other encapsulation, wrong
            length): decode it as a typed message instead.

        """
        layout = self._layout
        if layout.size == len(data):
            encoding, seconds, nanoseconds, length, name, *v = layout.unpack(data)
            if length == len(name) and encoding == b"\x00\x01":
                if name != self._name:
                    self._keep_name(name)
                return ImuFields(
                    seconds * 1_000_000_000 + nanoseconds,
                    (v[9], v[10], v[11]),
                    (v[5], v[6], v[7]),
                    self._frame_id,
                    (v[0], v[1], v[2], v[3]),
                    v[12],
                    v[8],
                    v[4],
                )
        return self._decode_new_layout(data)

    def _decode_new_layout(self, data: bytes) -> ImuFields:
        length = _imu_name_length(data)
        size = _body_start(_HEADER_SIZE + length) + _IMU_BODY_SIZE
        padding = size - _IMU_BODY_SIZE - _HEADER_SIZE - length
        self._layout = struct.Struct(f"<2s2xiII{length}s{padding}x4dd64x3dd64x3dd64x")
        self._keep_name(data[_HEADER_SIZE : _HEADER_SIZE + length])
        return self.decode(data[:size])

    def _keep_name(self, name: bytes) -> None:
        self._frame_id = _text(name)
        self._name = name


class StampedEncoder:
    """
    Serialises messages that consist of a header and doubles by patching one prepared message.

    Fill `values` in place, then call `message(stamp_ns)`. The bytes equal those of the typed path,
    with zeros in the gaps before aligned fields.

    Parameters
    ----------
    names
        The header's frame_id and further texts, as they follow each other.
    count
        Number of doubles.

    Attributes
    ----------
    values : ndarray, shape (count,)
        The doubles, a view of the prepared message.

    """

    def __init__(self, names: Sequence[str], count: int) -> None:
        text = bytearray(LITTLE_ENDIAN + bytes(8))
        for name in names:
            put_text(text, name)
        start = _body_start(len(text))
        # Four bytes ahead of the message bring its doubles to a multiple of eight.
        self._buffer = bytearray(4 + start + 8 * count)
        self._buffer[4 : 4 + len(text)] = text
        self._message = memoryview(self._buffer)[4:]
        self._pack_stamp = _STAMP.pack_into
        self.values: NDArray[np.float64] = np.frombuffer(
            self._buffer, "<f8", offset=4 + start, count=count
        )

    def message(self, stamp_ns: int) -> bytes:
        """Serialise the present values with the stamp `stamp_ns` [ns]."""
        self._pack_stamp(self._buffer, 8, *divmod(stamp_ns, 1_000_000_000))
        return bytes(self._message)

    def encode_values(self, stamp_ns: int, values: NDArray[np.float64]) -> bytes:
        """Serialise one message: stamp [ns] and values (count,)."""
        self.values[:] = values
        return self.message(stamp_ns)

    def messages(
        self, stamp_ns: NDArray[np.int64], values: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        """Serialise many, one a row: stamps (N,) [ns] and values (N, count)."""
        size, count = len(self._message), len(self.values)
        start = self.values.ctypes.data - np.frombuffer(self._message, np.uint8).ctypes.data
        layout = np.dtype(
            {
                "names": ["seconds", "nanoseconds", "values"],
                "formats": ["<i4", "<u4", ("<f8", count)],
                "offsets": [4, 8, start],
                "itemsize": size,
            }
        )
        rows = np.tile(np.frombuffer(self._message, np.uint8), (len(stamp_ns), 1))
        fields = rows.view(layout)[:, 0]
        fields["seconds"], fields["nanoseconds"] = np.divmod(stamp_ns, 1_000_000_000)
        fields["values"] = values
        return rows


class OdometryEncoder(StampedEncoder):
    """
    Serialises nav_msgs/Odometry.

    Fill the views and call `message(stamp_ns)`, or pass everything to `encode`.

    Attributes
    ----------
    position, quat_xyzw, linear, angular : ndarray, shape (3,), (4,), (3,), (3,)
        Pose of `child_frame_id` in `frame_id` [m], twist in `child_frame_id` [m/s, rad/s].
    pose_covariance, twist_covariance : ndarray, shape (6, 6)
        Linear part first.
    values : ndarray, shape (85,)
        All of the above in the order of the message: position, quat_xyzw, pose_covariance, linear,
        angular, twist_covariance.

    """

    def __init__(self, frame_id: str, child_frame_id: str) -> None:
        super().__init__((frame_id, child_frame_id), _ODOMETRY_BODY_COUNT)
        self.position = self.values[0:3]
        self.quat_xyzw = self.values[3:7]
        self.pose_covariance = self.values[7:43].reshape(6, 6)
        self.linear = self.values[43:46]
        self.angular = self.values[46:49]
        self.twist_covariance = self.values[49:85].reshape(6, 6)

    def encode(
        self,
        stamp_ns: int,
        position: ArrayLike,
        quat_xyzw: ArrayLike,
        pose_covariance: ArrayLike,
        linear: ArrayLike,
        angular: ArrayLike,
        twist_covariance: ArrayLike,
    ) -> bytes:
        """Serialise one message; shapes and units as the attributes of the class."""
        self.position[:] = position
        self.quat_xyzw[:] = quat_xyzw
        self.pose_covariance[:] = pose_covariance
        self.linear[:] = linear
        self.angular[:] = angular
        self.twist_covariance[:] = twist_covariance
        return self.message(stamp_ns)


def imu_records(messages: Sequence[bytes]) -> NDArray[Any]:
    """
    View many serialised Imu messages of one length as one structured array.

    Parameters
    ----------
    messages
        At least one serialised sensor_msgs/Imu.

    Returns
    -------
    ndarray, shape (N,)
        Fields `seconds`, `nanoseconds`, `name`, `orientation_xyzw` (4,), `orientation_covariance`
        (9,), `angular_rate` (3,), `angular_rate_covariance` (9,), `specific_force` (3,),
        `specific_force_covariance` (9,).

    Raises
    ------
    ValueError
        The messages differ in layout, or one is no little-endian CDR Imu: use `ImuDecoder` or the
        typed path one by one.

    """
    size = len(messages[0])
    joined = b"".join(messages)
    if len(joined) != size * len(messages) or any(len(m) != size for m in messages):
        raise ValueError("the Imu messages differ in length")
    return imu_rows(np.frombuffer(joined, np.uint8).reshape(-1, size))


def imu_rows(rows: NDArray[np.uint8]) -> NDArray[Any]:
    """View serialised Imu messages (N, size) in the same way, and raise likewise."""
    size = rows.shape[1]
    length = _imu_name_length(rows[0].tobytes())
    start = _body_start(_HEADER_SIZE + length)
    layout: list[tuple[str, Any, int]] = [
        ("encoding", "<u2", 0),
        ("seconds", "<i4", 4),
        ("nanoseconds", "<u4", 8),
        ("length", "<u4", 12),
        ("name", f"S{length}", _HEADER_SIZE),
        ("orientation_xyzw", ("<f8", 4), start),
        ("orientation_covariance", ("<f8", 9), start + 32),
        ("angular_rate", ("<f8", 3), start + 104),
        ("angular_rate_covariance", ("<f8", 9), start + 128),
        ("specific_force", ("<f8", 3), start + 200),
        ("specific_force_covariance", ("<f8", 9), start + 224),
    ]
    names, formats, offsets = zip(*layout, strict=True)
    records = np.frombuffer(
        rows.data,
        np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size}),
    )
    if np.any(records["encoding"] != 0x0100) or np.any(records["length"] != length):
        raise ValueError("the Imu messages differ in layout")
    return records


def _imu_name_length(data: bytes) -> int:
    """Check a serialised Imu and return the length of its frame_id, NUL included."""
    if len(data) < _HEADER_SIZE + _IMU_BODY_SIZE:
        raise ValueError(f"{len(data)} bytes are too short for an Imu message")
    encoding, _, _, _, length = _HEADER.unpack_from(data)
    if encoding != b"\x00\x01":
        raise ValueError(f"encapsulation {encoding.hex()} is not little-endian CDR")
    size = _body_start(_HEADER_SIZE + length) + _IMU_BODY_SIZE
    if length > _LONGEST_FRAME_ID or not size <= len(data) <= size + _RTPS_PADDING:
        raise ValueError(f"{len(data)} bytes are not the length of an Imu message")
    return int(length)


def _body_start(text_end: int) -> int:
    """Return the next offset at which doubles may lie, counted with the encapsulation header."""
    return text_end + (4 - text_end) % 8


def _text(name: bytes) -> str:
    return name.rstrip(b"\0").decode(errors="replace")


def stamped(t_ns: int, frame_id: str) -> bytearray:
    """Begin a message with a header: stamp [ns] and frame."""
    buffer = bytearray(LITTLE_ENDIAN + _STAMP.pack(*divmod(t_ns, 1_000_000_000)))
    put_text(buffer, frame_id)
    return buffer


def put_text(buffer: bytearray, text: str) -> None:
    """Append a string."""
    encoded = text.encode(errors="replace")
    put_count(buffer, len(encoded) + 1)
    buffer += encoded + b"\0"


def put_count(buffer: bytearray, count: int) -> None:
    """Append the length of what follows."""
    buffer += _PADDING[len(buffer) % 4] + _COUNT.pack(count)


def put_doubles(buffer: bytearray, *arrays: ArrayLike) -> None:
    """Append arrays of doubles."""
    buffer += bytes(_body_start(len(buffer)) - len(buffer))
    for array in arrays:
        buffer += np.asarray(array, "<f8").tobytes()
