"""ROS 2's messages as Cyclone DDS serialises them.

Their annotations are read when they are first sent, so that they must be types and no text: no ``annotations`` are
imported from the future here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from cyclonedds.idl import IdlStruct
from cyclonedds.idl import annotations as annotate
from cyclonedds.idl.types import float64, int32, sequence, uint32

NANO = 10**9


@dataclass
@annotate.final
@annotate.autoid("sequential")
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """builtin_interfaces/msg/Time."""

    sec: int32
    nanosec: uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """std_msgs/msg/Header."""

    stamp: Time
    frame_id: str


@dataclass
@annotate.final
@annotate.autoid("sequential")
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """sensor_msgs/msg/JointState."""

    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
@annotate.final
@annotate.autoid("sequential")
class MultiArrayDimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    """std_msgs/msg/MultiArrayDimension."""

    label: str
    size: uint32
    stride: uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class MultiArrayLayout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    """std_msgs/msg/MultiArrayLayout."""

    dim: sequence[MultiArrayDimension] = field(default_factory=list)
    data_offset: uint32 = 0


@dataclass
@annotate.final
@annotate.autoid("sequential")
class Float64MultiArray(IdlStruct, typename="std_msgs::msg::dds_::Float64MultiArray_"):
    """std_msgs/msg/Float64MultiArray."""

    layout: MultiArrayLayout
    data: sequence[float64]


def joint_state(stamp: float, names: Sequence[str], position: Sequence[float]) -> JointState:
    """A measurement as a message."""
    whole = round(stamp * NANO)
    return JointState(Header(Time(whole // NANO, whole % NANO), ""), list(names), list(position), [], [])


def multi_array(values: Sequence[float]) -> Float64MultiArray:
    """A command as a message."""
    return Float64MultiArray(MultiArrayLayout(), list(values))
