"""CDR, type hashes and identities against what others have published, and against any garbage."""

import random
import struct
import tracemalloc

import numpy as np
import pytest

from maniple.core.errors import MessageError
from maniple.core.geometry import Pose
from maniple.transport.ros2_cdr import (
    LASER_SCAN,
    ODOMETRY,
    TF,
    TWIST,
    TWIST_STAMPED,
    decode,
    encode,
    gid_of,
    new,
    type_hash,
)
from maniple.transport.ros2_messages import (
    Velocity3,
    header,
    odometry,
    transforms,
    twist,
    twist_stamped,
)

# `ros2 topic info --verbose` prints them; each is in many public repositories, for instance:
PUBLIC_HASHES = {
    # github.com/ros2/rmw_zenoh, docs/design.md
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    # printed for /cmd_vel of ROS 2 Jazzy's turtlesim in several tutorials
    TWIST: "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    # printed for ros_gz_bridge's /cmd_vel
    TWIST_STAMPED: "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    # in a key of rmw_zenoh that a JavaScript client tests with
    ODOMETRY: "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    # in the constants of ros-z (github.com/ZettaScaleLabs/ros-z)
    LASER_SCAN: "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    # `type_description_hash` of /tf in the metadata of a rosbag2 of Jazzy
    TF: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "geometry_msgs/msg/Pose": "RIHS01_d501954e9476cea2996984e812054b68026ae0bfae789d9a10b23daf35cc90fa",
    "geometry_msgs/msg/Transform": "RIHS01_beb83fbe698636351461f6f35d1abb20010c43d55374d81bd041f1ba2581fddc",
    "builtin_interfaces/msg/Time": "RIHS01_b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
}

# What rmw_zenoh_cpp 0.1.9's own hash gives for the bytes (31 i + 7) mod 256, by length: (low, high).
# Published with a reimplementation that was checked against it.
PUBLIC_XXH3 = {
    0: (0x6001C324468D497F, 0x99AA06D3014798D8),
    16: (0xF853DD94614DFA07, 0x650FE308C566747D),
    128: (0x1E04FAD9F0CACB4D, 0xB4F87B99D2DB8A51),
}
TALKER = (
    "@ros2_lv/0/abcdef0123456789abcdef0123456789/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,"
)


class Writer:
    """CDR as the OMG defines it (plain, little-endian), for the types that are used here."""

    def __init__(self) -> None:
        self.data = b"\x00\x01\x00\x00"

    def put(self, form: str, *values: float) -> "Writer":
        size = struct.calcsize(form)
        for value in values:
            self.data += bytes(-(len(self.data) - 4) % size) + struct.pack(f"<{form}", value)
        return self

    def text(self, text: str) -> "Writer":
        self.put("I", len(text) + 1)
        self.data += text.encode() + b"\0"
        return self


@pytest.mark.parametrize("type_name", PUBLIC_HASHES)
def test_type_hashes_are_those_that_ros_2_prints(type_name: str) -> None:
    assert type_hash(type_name) == PUBLIC_HASHES[type_name]


def test_a_string_is_the_bytes_that_ros_2_sends() -> None:
    # github.com/ros2/demos, demo_nodes_cpp/src/topics/talker_serialized_message.cpp
    wire = bytes([0x00, 0x01, 0x00, 0x00, 0x0F, 0x00, 0x00, 0x00]) + b"Hello World: 1\0"
    assert encode(new("std_msgs/msg/String", data="Hello World: 1")) == wire
    assert decode(wire, "std_msgs/msg/String").data == "Hello World: 1"


def test_messages_are_encoded_as_the_omg_says() -> None:
    velocity = Velocity3(0.5, -0.25, 0.125)
    stamped = Writer().put("i", 3).put("I", 7).text("base_link").put("d", 0.5, 0.125, 0, 0, 0, -0.25)
    assert encode(twist(velocity)) == Writer().put("d", 0.5, 0.125, 0, 0, 0, -0.25).data
    assert encode(twist_stamped(velocity, 3_000_000_007, "base_link")) == stamped.data
    located = Writer().put("i", 3).put("I", 7).text("odom").text("base_link")
    located.put("d", 1, 2, 0, 0, 0, 0, 1, *[0] * 36, 0.5, 0.125, 0, 0, 0, -0.25, *[0] * 36)
    message = odometry(Pose(1.0, 2.0, 0.0), velocity, 3_000_000_007, "odom", "base_link")
    assert encode(message) == located.data
    frames = Writer().put("I", 1).put("i", 3).put("I", 7).text("odom").text("base_link")
    frames.put("d", 1, 2, 0, 0, 0, 0, 1)
    assert encode(transforms({"base_link": ("odom", Pose(1, 2, 0))}, 3_000_000_007)) == frames.data


def test_a_scan_is_encoded_as_the_omg_says() -> None:
    ranges = np.array([1.5, np.inf], dtype=np.float32)
    numbers = dict(zip(NUMBERS, (-1.0, 1.0, 2.0, 0.0, 0.5, 0.25, 8.0), strict=True))
    scan = new(
        LASER_SCAN,
        header=header(3_000_000_007, "laser"),
        ranges=ranges,
        intensities=ranges[:0],
        **numbers,
    )
    wire = Writer().put("i", 3).put("I", 7).text("laser").put("f", *numbers.values())
    wire.put("I", 2).put("f", 1.5, np.inf).put("I", 0)
    assert encode(scan) == wire.data
    assert decode(wire.data, LASER_SCAN).ranges.tolist() == [1.5, np.inf]


NUMBERS = (
    "angle_min",
    "angle_max",
    "angle_increment",
    "time_increment",
    "scan_time",
    "range_min",
    "range_max",
)


def test_big_endian_is_understood() -> None:
    wire = b"\x00\x00\x00\x00" + struct.pack(">6d", 0.5, 0, 0, 0, 0, 1.0)
    assert decode(wire, TWIST).linear.x == 0.5


@pytest.mark.parametrize("length", PUBLIC_XXH3)
def test_the_hash_behind_identities_is_that_of_rmw_zenoh(length: int) -> None:
    from xxhash import xxh3_128_intdigest

    low, high = PUBLIC_XXH3[length]
    assert xxh3_128_intdigest(bytes((31 * i + 7) % 256 for i in range(length))) == high << 64 | low


def test_the_identity_of_a_publisher_is_that_which_rmw_zenoh_gives_it() -> None:
    assert gid_of(TALKER).hex() == "5d93eb0aa1fed6741fd0751922ffa030"


@pytest.mark.parametrize("type_name", ["x", "std_msgs/String", "my_msgs/msg/Robot", ""])
def test_a_type_that_ros_2_has_not_is_refused(type_name: str) -> None:
    with pytest.raises(MessageError, match="is no message type of ROS 2"):
        type_hash(type_name)
    with pytest.raises(MessageError, match="is no message type of ROS 2"):
        new(type_name)


def samples() -> dict[str, bytes]:
    at, velocity = Pose(1.0, 2.0, 0.3), Velocity3(0.5, -0.25, 0.125)
    scan = new(
        LASER_SCAN,
        header=header(5, "laser"),
        ranges=np.linspace(1, 5, 180, dtype=np.float32),
        intensities=np.zeros(180, dtype=np.float32),
        **dict.fromkeys(NUMBERS, 0.5),
    )
    return {
        TWIST: encode(twist(velocity)),
        TWIST_STAMPED: encode(twist_stamped(velocity, 5, "base_link")),
        ODOMETRY: encode(odometry(at, velocity, 5, "odom", "base_link")),
        LASER_SCAN: encode(scan),
        TF: encode(transforms({"base_link": ("odom", at), "laser": ("base_link", at)}, 5)),
    }


def corrupted(data: bytes, chance: random.Random) -> bytes:
    """Cut short, drawn out, or with some bytes or one length replaced."""
    some = bytearray(data)
    kind = chance.randrange(5)
    if kind == 0:
        return bytes(some[: chance.randrange(len(some))])
    if kind == 1:
        return bytes(some) + chance.randbytes(chance.randrange(1, 64))
    if kind == 2:
        return chance.randbytes(chance.randrange(300))
    if kind == 3:
        at = chance.randrange(len(some) - 4)
        some[at : at + 4] = struct.pack("<I", chance.choice([2**32 - 1, 2**31, 2**24, 65_536]))
        return bytes(some)
    for _ in range(chance.randrange(1, 6)):
        some[chance.randrange(len(some))] = chance.randrange(256)
    return bytes(some)


def test_ten_thousand_corrupted_messages_are_decoded_or_refused_and_take_no_memory() -> None:
    chance = random.Random(6)
    good = samples()
    for type_name, data in good.items():
        decode(data, type_name)
    refused = 0
    tracemalloc.start()
    for number in range(10_000):
        type_name = list(good)[number % len(good)]
        try:
            decode(corrupted(good[type_name], chance), type_name)
        except MessageError:
            refused += 1
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert 4_000 < refused < 10_000
    assert most < 2_000_000
