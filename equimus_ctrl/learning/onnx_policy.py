"""Policies as ONNX files: for other programs, and for policies of other programs.

The graph takes ``observation`` (n, size) and gives ``action`` (n, na) within ±1, both float32. Normalisation and limits
are in it, so that nothing else has to know of them. What ``policy.json`` says of a policy in a zip file stands in the
metadata under ``equimus_ctrl``, as JSON: the robot, what is seen of it, and the normalisation.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import FAILURES, ConfigError, needs
from equimus_ctrl.learning.network import Normalisation
from equimus_ctrl.learning.policy import SCHEMA, Policy, Suited, checked, suited_of
from equimus_ctrl.types import Array

SEEN, ACTION, ABOUT = "observation", "action", "equimus_ctrl"
OPSET, IR = 17, 8
"""Of ONNX 1.12, which everything that is still in use reads."""
NODES: dict[str, tuple[str, dict[str, Any]]] = {
    "identity": ("Identity", {}),
    "tanh": ("Tanh", {}),
    "relu": ("Relu", {}),
    "elu": ("Elu", {"alpha": 1.0}),
    "leaky_relu": ("LeakyRelu", {"alpha": 0.01}),
}
"""What ONNX calls the activations of ``network.ACTIVATIONS``."""


def check_onnx() -> None:
    """Raise NotAvailable where the library ``onnx``, which writes these files, is not installed."""
    try:
        import onnx  # noqa: F401
    except ImportError:
        raise needs("onnx", "onnx", "writing ONNX files") from None


def to_onnx(policy: Policy) -> bytes:
    """A policy as an ONNX file.

    Raises:
        NotAvailable: where the library ``onnx`` is not installed.
    """
    check_onnx()
    from onnx import TensorProto, helper, numpy_helper

    scale, network = policy.normalisation, policy.network
    own: dict[str, Any] = {
        "mean": scale.mean, "deviation": np.sqrt(scale.variance + scale.epsilon), "clip_low": np.array(-scale.clip),
        "clip_high": np.array(scale.clip), "low": np.array(-1.0), "high": np.array(1.0),
    }  # fmt: skip
    nodes = [
        helper.make_node("Sub", [SEEN, "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "deviation"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "clip_low", "clip_high"], ["layer.0"]),
    ]
    layers = zip(network.weights, network.biases, network.activations, strict=True)
    for k, (weight, bias, name) in enumerate(layers):
        own |= {f"weight.{k}": weight, f"bias.{k}": bias}
        kind, more = NODES[name]
        nodes += [
            helper.make_node("Gemm", [f"layer.{k}", f"weight.{k}", f"bias.{k}"], [f"line.{k}"], transB=1),
            helper.make_node(kind, [f"line.{k}"], [f"layer.{k + 1}"], **more),
        ]
    nodes.append(helper.make_node("Clip", [f"layer.{len(network.weights)}", "low", "high"], [ACTION]))
    single = {name: numpy_helper.from_array(np.asarray(values, np.float32), name) for name, values in own.items()}
    graph = helper.make_graph(
        nodes, "policy",
        [helper.make_tensor_value_info(SEEN, TensorProto.FLOAT, ["n", network.inputs])],
        [helper.make_tensor_value_info(ACTION, TensorProto.FLOAT, ["n", network.outputs])],
        list(single.values()),
    )  # fmt: skip
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR, producer_name="equimus_ctrl"
    )
    helper.set_model_props(model, {ABOUT: json.dumps(policy.about())})
    return bytes(model.SerializeToString(deterministic=True))


@dataclass(frozen=True, eq=False)
class OnnxPolicy:
    """A policy that ONNX Runtime computes, see ``policy.Policy``.

    Attributes:
        session: of ONNX Runtime.
        suited: what it is for.
        size: of an observation.
        record: how it was trained, as JSON data.
    """

    session: Any
    suited: Suited
    size: int
    record: Any = field(default_factory=dict)

    @classmethod
    def from_bytes(cls, data: bytes, where: str) -> OnnxPolicy:
        """What an ONNX file holds.

        Raises:
            NotAvailable: where ONNX Runtime is not installed.
            ConfigError: where the file is damaged, or does not say what it is for.
        """
        try:
            import onnxruntime
        except ImportError:
            raise needs("onnxruntime", "onnx", "a policy from an ONNX file") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
            told = session.get_modelmeta().custom_metadata_map.get(ABOUT)
        except FAILURES as error:
            raise ConfigError(f"{where}: is no ONNX file that can be run, or damaged ({error})") from None
        if told is None:
            raise ConfigError(
                f"{where}: says nothing of the robot that it is for nor of what it sees; expected the metadata "
                f"{ABOUT!r}, as train --export writes it"
            )
        return _read(cls, session, told, where)

    def act(self, observed: NDArray[np.floating[Any]]) -> Array:
        """(n, na) actions within ±1, of observations (n, size), without exploring.

        Raises:
            ConfigError: for observations of another size, or that are not finite.
        """
        checked(observed, self.size)
        (given,) = self.session.run([ACTION], {SEEN: np.asarray(observed, np.float32)})
        if not np.isfinite(given).all():
            raise ConfigError(f"the policy gives {np.asarray(given).ravel().tolist()}, which are not finite")
        return np.asarray(np.clip(given, -1.0, 1.0), dtype=np.float64)


def _read(cls: type[OnnxPolicy], session: Any, told: str, where: str) -> OnnxPolicy:
    about: Any = None
    try:
        about = json.loads(told)
        if not isinstance(about, dict) or about.get("schema") != SCHEMA:
            found = about.get("schema") if isinstance(about, dict) else None
            raise ConfigError(f"{where}: its schema is {found!r}, expected {SCHEMA!r}")
        scale = about.get("normalisation") or {}
        if "mean" not in scale or "variance" not in scale:
            raise ConfigError(
                f"{where}: does not say how observations are normalised, and might see other numbers than in training; "
                "expected mean and variance in its metadata, as train --export writes it"
            )
        own = {key: scale[key] for key in ("epsilon", "clip")}
        mean = Normalisation(np.array(scale["mean"], float), np.array(scale["variance"], float), **own).mean
        suited, record = suited_of(about["for"], where), about["record"]
    except ConfigError as error:
        said = str(error)
        raise ConfigError(said if said.startswith(where) else f"{where}: {said}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{where}: is damaged or not as train --export writes it ({error})") from None
    wanted = {SEEN: mean.size, ACTION: len(suited.actuators)}
    found = {own.name: own.shape for own in (*session.get_inputs(), *session.get_outputs())}
    for name, size in wanted.items():
        shape = found.get(name)
        if len(found) != len(wanted) or shape is None or len(shape) != 2 or shape[1] != size:
            raise ConfigError(
                f"{where}: takes and gives {found}; expected {SEEN} (n, {wanted[SEEN]}) and {ACTION} "
                f"(n, {wanted[ACTION]})"
            )
    return cls(session, suited, mean.size, record)
