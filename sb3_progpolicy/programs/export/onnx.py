"""A program as an ONNX model, for every runtime that reads one; built from plain data, without torch."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from importlib import import_module
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_progpolicy.programs.export.visitor import title
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.programs.interpreter import Semantics
from sb3_progpolicy.programs.syntax import GATES, Condition, ProgramData
from sb3_progpolicy.programs.validation import check_program

# Old enough for the runtimes of recent years.
OPSET, IR_VERSION = 17, 8
ENVS = "n_envs"


def export_onnx(program: ProgramData, path: str | os.PathLike[str] | Any, semantics: Semantics = "crisp") -> None:
    """Write a program as an ONNX model (opset 17) that takes one step for ``n_envs`` environments at once.

    All numbers are float64, as in :class:`~sb3_progpolicy.programs.interpreter.ProgramRunner`. A runtime may add in
    another order, so scores are equal up to rounding, and actions where they are not tied by that little. The model
    keeps no memory: give zeros at first, then what it returned.

    Inputs: ``x`` ``(n_envs, n_inputs)``, as :func:`~sb3_progpolicy.programs.interpreter.join_inputs` builds it; for the
    recurrent condition k, counted from 1, ``h<k>`` and, of an LSTM, ``c<k>``, ``(n_envs, hidden_size)``.

    Outputs: ``action``, with the type and the shape that the runner's have; ``condition_values``
    ``(n_envs, n_conditions)``, if there are any; ``controller_outputs`` ``(n_envs, n_controllers, n_outputs)``;
    ``mixture_weights`` ``(n_envs, n_controllers)``; ``h<k>_next`` and ``c<k>_next``.

    The names of inputs and outputs and the title are in the model's metadata as JSON.

    :param program: what to write
    :param path: a path or an open binary file to write to
    :param semantics: ``"crisp"``, a real if-then-else, or ``"soft"``, the mixture of training
    :raises ValueError: if the program is not well formed or an argument is not accepted
    :raises ImportError: if onnx is missing
    """
    check_program(program)
    if semantics not in ("crisp", "soft"):
        raise ValueError(f"semantics={semantics!r} is not accepted; it is 'crisp' or 'soft'")
    try:
        onnx = import_module("onnx")
    except ImportError as error:
        raise ImportError('export_onnx needs onnx: pip install "sb3-progpolicy[onnx]"') from error
    model = _Graph(program, semantics, onnx).model()
    onnx.checker.check_model(model, full_check=True)
    content = model.SerializeToString(deterministic=True)
    if isinstance(path, (str, os.PathLike)):
        write_atomically(path, content)
    else:
        path.write(content)


class _Graph:
    """Nodes of the model in the order in which they are computed; methods return the name of their result."""

    def __init__(self, program: ProgramData, semantics: Semantics, onnx: Any) -> None:
        self.program, self.soft, self.onnx = program, semantics == "soft", onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self.inputs = [self._value("x", np.float64, program.n_inputs)]
        self.outputs: list[Any] = []

    def model(self) -> Any:
        """Return the whole model."""
        program, helper = self.program, self.onnx.helper
        n_controllers, n_outputs = len(program.controllers), program.action.n_outputs
        values = [self._condition(condition, k) for k, condition in enumerate(program.conditions, start=1)]
        if values:
            self._output("condition_values", "Concat", values, np.float64, len(values), axis=1)
        rows = [row for controller in program.controllers for row in controller.weights]
        constants = [constant for controller in program.controllers for constant in controller.bias]
        flat = self._affine("x", np.array(rows).reshape(len(rows), program.n_inputs), constants)
        shape = self._constant([0, n_controllers, n_outputs], np.int64)
        outputs = self._output("controller_outputs", "Reshape", [flat, shape], np.float64, n_controllers, n_outputs)
        weights = self._mixture_weights(values)
        self._action(self._taken(values, weights, outputs))
        graph = helper.make_graph(self.nodes, "program", self.inputs, self.outputs, self.constants)
        model = helper.make_model(
            graph,
            producer_name="sb3-progpolicy",
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
        )
        texts = {
            "title": title(program),
            "semantics": "soft" if self.soft else "crisp",
            "input_names": list(map(str, program.input_names)),
            "output_names": list(map(str, program.output_names)),
        }
        helper.set_model_props(model, {key: json.dumps(value) for key, value in texts.items()})
        return model

    def _condition(self, condition: Condition, k: int) -> str:
        """Advance a condition and return its B, ``(n_envs, 1)``."""
        if condition.cell == "affine":
            return self._affine("x", (condition.readout,), (condition.readout_bias,))
        if condition.cell == "min":
            sums = self._affine("x", condition.weight_ih, condition.bias_ih)
            return self._node("ReduceMin", sums, axes=[1], keepdims=1)
        size, n_inputs = condition.hidden_size, self.program.n_inputs
        memory = {f"{kind}{k}": f"{kind}{k}_next" for kind in ("hc" if condition.cell == "lstm" else "h")}
        self.inputs += [self._value(name, np.float64, size) for name in memory]
        gates = self._affine("x", np.array(condition.weight_ih).reshape(-1, n_inputs), condition.bias_ih)
        recurrent = self._affine(f"h{k}", condition.weight_hh, condition.bias_hh)
        n_gates = len(GATES[condition.cell])
        if condition.cell == "gru":
            self._gru(k, self._split(gates, n_gates, size), self._split(recurrent, n_gates, size), size)
        elif condition.cell == "switch":
            self._switch(k, self._split(self._node("Add", gates, recurrent), n_gates, size), size)
        elif condition.cell == "lstm":
            self._lstm(k, self._split(self._node("Add", gates, recurrent), n_gates, size), size)
        else:
            self._output(f"h{k}_next", "Tanh", [self._node("Add", gates, recurrent)], np.float64, size)
        return self._affine(f"h{k}_next", (condition.readout,), (condition.readout_bias,))

    def _gru(self, k: int, gates: Sequence[str], recurrent: Sequence[str], size: int) -> None:
        r, z = (self._node("Sigmoid", self._node("Add", gates[gate], recurrent[gate])) for gate in (0, 1))
        n = self._node("Tanh", self._node("Add", gates[2], self._node("Mul", r, recurrent[2])))
        change = self._node("Mul", z, self._node("Sub", f"h{k}", n))
        self._output(f"h{k}_next", "Add", [n, change], np.float64, size)

    def _lstm(self, k: int, gates: Sequence[str], size: int) -> None:
        i, f, o = (self._node("Sigmoid", gates[gate]) for gate in (0, 1, 3))
        written = self._node("Mul", i, self._node("Tanh", gates[2]))
        cell = self._output(f"c{k}_next", "Add", [self._node("Mul", f, f"c{k}"), written], np.float64, size)
        self._output(f"h{k}_next", "Mul", [o, self._node("Tanh", cell)], np.float64, size)

    def _switch(self, k: int, gates: Sequence[str], size: int) -> None:
        kept = self._node("Where", self._holds(gates[1]), self._constant(0.0), f"h{k}")
        self._output(f"h{k}_next", "Where", [self._holds(gates[0]), self._constant(1.0), kept], np.float64, size)

    def _mixture_weights(self, values: Sequence[str]) -> str:
        """Crisp: 1 for the first condition that is not below 0. Soft: ``s_k * prod_{j<k}(1 - s_j)``."""
        n_controllers = len(values) + 1
        if not self.soft or not values:
            rows = np.eye(n_controllers)
            shape = self._node(
                "Concat",
                self._node("Shape", "x", start=0, end=1),
                self._constant([n_controllers], np.int64),
                axis=0,
            )
            chosen = self._node("Expand", self._constant(rows[-1:]), shape)
            for value, row in reversed(list(zip(values, rows, strict=False))):
                chosen = self._node("Where", self._holds(value), self._constant(row[None]), chosen)
            return self._output("mixture_weights", "Identity", [chosen], np.float64, n_controllers)
        one, rest = self._constant(1.0), ""
        weights = []
        for value in values:
            scaled = self._node("Div", value, self._constant(self.program.temperature))
            chosen = self._node("Sigmoid", scaled)
            other = self._node("Sub", one, chosen)
            weights.append(self._node("Mul", rest, chosen) if rest else chosen)
            rest = self._node("Mul", rest, other) if rest else other
        return self._output("mixture_weights", "Concat", [*weights, rest], np.float64, n_controllers, axis=1)

    def _taken(self, values: Sequence[str], weights: str, outputs: str) -> str:
        """The outputs that decide, ``(n_envs, n_outputs)``: of the controller reached, or the mixture's."""
        if self.soft:
            if self.program.action.kind == "box" and self.program.semantics == "branches":
                likeliest = self._node("ArgMax", weights, axis=1, keepdims=0)
                weights = self._node("Gather", self._constant(np.eye(len(values) + 1)), likeliest, axis=0)
            column = self._node("Unsqueeze", weights, self._constant([2], np.int64))
            mixed = self._node("Mul", column, self._distribution(outputs))
            return self._node("ReduceSum", mixed, self._constant([1], np.int64), keepdims=0)
        parts = [
            self._node("Gather", outputs, self._constant(index, np.int64), axis=1) for index in range(len(values) + 1)
        ]
        taken = parts[-1]
        for value, part in reversed(list(zip(values, parts, strict=False))):
            taken = self._node("Where", self._holds(value), part, taken)
        return taken

    def _distribution(self, outputs: str) -> str:
        """What the soft semantics mixes: probabilities of discrete actions, the outputs themselves for a Box."""
        action = self.program.action
        if action.kind == "box":
            return outputs
        if action.kind == "multi_binary":
            return self._node("Sigmoid", outputs)
        parts = [self._node("Softmax", part, axis=2) for part in self._parts(outputs, 2)]
        return self._node("Concat", *parts, axis=2)

    def _action(self, taken: str) -> None:
        action, tensor = self.program.action, self.onnx.TensorProto
        if action.kind == "box":
            low, high = (self._constant([bound]) for bound in (action.low, action.high))
            clipped = self._node("Min", self._node("Max", taken, low), high)
            self._output("action", "Cast", [clipped], np.float32, action.n_outputs, to=tensor.FLOAT)
        elif action.kind == "multi_binary":
            on = self._node("Greater", taken, self._constant(0.5 if self.soft else 0.0))
            self._output("action", "Cast", [on], np.int8, action.n_outputs, to=tensor.INT8)
        elif action.kind == "discrete":
            best = self._node("ArgMax", taken, axis=1, keepdims=0)
            self._output("action", "Add", [best, self._constant([action.start], np.int64)], np.int64)
        else:
            best_of = [self._node("ArgMax", part, axis=1) for part in self._parts(taken, 1)]
            self._output("action", "Concat", best_of, np.int64, len(action.sizes), axis=1)

    def _parts(self, name: str, axis: int) -> list[str]:
        """The outputs that belong to each part of a discrete action."""
        ends = list(accumulate(self.program.action.sizes))
        starts = [0, *ends[:-1]]
        if len(ends) == 1:
            return [name]
        limits = ([self._constant([limit], np.int64) for limit in pair] for pair in zip(starts, ends, strict=True))
        axes = self._constant([axis], np.int64)
        return [self._node("Slice", name, start, end, axes) for start, end in limits]

    def _split(self, name: str, n_parts: int, size: int) -> list[str]:
        names = [f"{name}_{part}" for part in range(n_parts)]
        sizes = self._constant([size] * n_parts, np.int64)
        self.nodes.append(self.onnx.helper.make_node("Split", [name, sizes], names, axis=1))
        return names

    def _holds(self, value: str) -> str:
        return self._node("GreaterOrEqual", value, self._constant(0.0))

    def _affine(self, name: str, weights: ArrayLike, constant: ArrayLike) -> str:
        """``constant + weights · name``"""
        columns = np.asarray(weights, dtype=np.float64).T
        return self._node("Add", self._node("MatMul", name, self._constant(columns)), self._constant(constant))

    def _node(self, operator: str, *names: str, **attributes: Any) -> str:
        name = f"v{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, list(names), [name], **attributes))
        return name

    def _output(self, name: str, operator: str, names: list[str], kind: Any, *shape: int, **attributes: Any) -> str:
        self.nodes.append(self.onnx.helper.make_node(operator, names, [name], **attributes))
        self.outputs.append(self._value(name, kind, *shape))
        return name

    def _value(self, name: str, kind: Any, *shape: int) -> Any:
        helper = self.onnx.helper
        return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(np.dtype(kind)), [ENVS, *shape])

    def _constant(self, value: ArrayLike, kind: Any = np.float64) -> str:
        name = f"k{len(self.constants)}"
        array = np.ascontiguousarray(np.array(value, dtype=kind))
        self.constants.append(self.onnx.numpy_helper.from_array(array.reshape(np.shape(value)), name))
        return name
