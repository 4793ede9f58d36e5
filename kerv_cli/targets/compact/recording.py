"""Record what a torch module computes as a table of operations: run it on a stand-in for a tensor.

So a network is defined once, in torch. A `Recorded` value knows the place of each of its elements in a frame of
numbers. Views (slices, reshapes, concatenations) only move these places; everything else becomes an operation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

LINEAR, NORM, SILU, TANH, ADD, MULTIPLY, AFFINE, CLAMP, GATHER, EMBED, ARGMAX, ATTEND = range(12)
"""What an operation computes."""
HALF, INT8, FLOAT = range(3)
"""How the weights of a product are stored."""
PANEL = 64
"""Outputs of a matrix that lie side by side."""
COLUMNS = ["code", "out", "a", "b", "rows", "width", "stride", "first", "step", "weights", "factors", "panels", "kind"]
"""Columns of a table of operations. out, a, b: places in a frame. first: a place in the table's numbers or indices."""
_ALIGNED = 16
_VIEWS = frozenset({"view", "flatten", "unflatten", "chunk", "split", "expand"})


class Recorded:
    """Stands for a float32 tensor of batch 1 on a CPU. place: of each element in a frame, a tensor of its shape."""

    requires_grad = is_cuda = False
    dtype, device = torch.float32, torch.device("cpu")

    def __init__(self, tape: Tape, place: Tensor) -> None:
        self.tape, self.place, self.shape = tape, place, place.shape

    @classmethod
    def __torch_function__(cls, function: Any, _: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _FUNCTIONS[function](*args, **(kwargs or {}))

    def __getattr__(self, name: str) -> Any:
        if name not in _VIEWS:
            raise AttributeError(f"{name}: not known to a recording")

        def view(*args: Any, **kwargs: Any) -> Any:
            found = getattr(self.place, name)(*args, **kwargs)
            return Recorded(self.tape, found) if isinstance(found, Tensor) else [Recorded(self.tape, x) for x in found]

        return view

    def __getitem__(self, index: Any) -> Recorded:
        return Recorded(self.tape, self.place[index])

    def to(self, *_: Any) -> Recorded:
        """Return itself: a recording knows one number format."""
        return self

    def __add__(self, other: Any) -> Recorded:
        return self.tape.elementwise(ADD, self, other) if isinstance(other, Recorded) else self.affine(1.0, other)

    def __sub__(self, other: Any) -> Recorded:
        return self + (other.affine(-1.0, 0.0) if isinstance(other, Recorded) else -other)

    def __mul__(self, other: Any) -> Recorded:
        return self.tape.elementwise(MULTIPLY, self, other) if isinstance(other, Recorded) else self.affine(other, 0.0)

    def __truediv__(self, other: Any) -> Recorded:
        return self.affine(1.0 / other, 0.0)

    def affine(self, factor: Any, offset: Any) -> Recorded:
        """Return self · factor + offset, of constants."""
        constants = [torch.as_tensor(x, dtype=torch.float32) for x in (factor, offset)]
        shape = torch.broadcast_shapes(self.shape, *(x.shape for x in constants))
        numbers = torch.cat([x.expand(shape).flatten() for x in constants])
        return self.tape.elementwise(AFFINE, self.expand(shape), numbers=numbers)

    def clamp(self, low: float, high: float) -> Recorded:
        """Limit all elements."""
        return self.tape.elementwise(CLAMP, self, numbers=[low, high])

    def mean(self, dim: int) -> Recorded:
        """Average over dimension 1."""
        assert dim == 1
        first, *others = (self[:, i] for i in range(self.shape[1]))
        return sum(others, start=first) / self.shape[1]

    def argmax(self, dim: int) -> Recorded:
        """Return the index (1,) of the greatest of all elements."""
        assert dim == -1
        return self.tape.emit(ARGMAX, (1,), [self], self.place.numel())

    def attend(self, heads: int, cos: Tensor, sin: Tensor) -> Recorded:
        """Attend over the cache of the next layer: q, k and v (…, 3 E) -> (…, E). cos, sin: (positions, 1, C)."""
        tape, width = self.tape, self.shape[-1] // 3
        layer, tables = tape.cache[0], torch.cat([cos, sin], 1)
        tape.cache = layer + 1, heads, width // heads
        return tape.emit(ATTEND, (*self.shape[:-1], width), [self], 3 * width, tables, stride=layer)


class Tape:
    """The operations recorded so far, and the numbers and indices that they refer to."""

    def __init__(self) -> None:
        self.ops: list[dict[str, Any]] = []
        self.numbers: list[np.ndarray] = []
        self.indices: list[int] = []
        self.begins = [0]  # of the registers; the last one is where the next register will begin
        self.cache = 0, 1, 1  # layers that attend, heads, channels

    def register(self, *shape: int) -> Recorded:
        """Return a new place for a tensor of this shape."""
        first, size = self.begins[-1], int(np.prod(shape))
        self.begins.append(first + size + 1)  # a gap: elements of two registers are never side by side
        return Recorded(self, torch.arange(first, first + size).view(shape))

    def emit(
        self,
        code: int,
        out: Recorded | Sequence[int],
        inputs: Sequence[Recorded],
        width: int,
        numbers: Any = (),
        **columns: Any,
    ) -> Recorded:
        """Append an operation on rows of `width` elements. out: where its result goes, or the shape of a new place."""
        out = out if isinstance(out, Recorded) else self.register(*out)
        lined = [self.lined(x, width) for x in inputs]
        first = [int(x.place.flatten()[0]) for x in (out, *(x for x, _, _ in lined))]
        shape = {"rows": lined[0][1], "width": width, "stride": lined[0][2], "first": self.placed(numbers)}
        places = dict(zip(("out", "a", "b"), first, strict=False))
        self.ops.append({"code": code, "reads": [x.place for x, _, _ in lined], **shape, **places, **columns})
        return out

    def lined(self, x: Recorded, width: int) -> tuple[Recorded, int, int]:
        """Return x with contiguous rows of `width` elements at equal distances (a copy if necessary), their number and
        distance."""
        rows = x.place.reshape(-1, width)
        stride = int(rows[1, 0] - rows[0, 0]) if len(rows) > 1 else width
        if torch.equal(rows, rows[0, 0] + torch.arange(len(rows))[:, None] * stride + torch.arange(width)):
            return x, len(rows), stride
        return self.copied(x, self.register(*x.shape)), len(rows), width

    def copied(self, x: Recorded, out: Recorded) -> Recorded:
        """Copy the elements of x, one after the other."""
        places = x.place.flatten().tolist()
        op = {"code": GATHER, "rows": 1, "width": len(places), "first": len(self.indices), "reads": [x.place]}
        self.ops.append(op | {"out": int(out.place.flatten()[0])})
        self.indices += places
        return out

    def elementwise(self, code: int, *inputs: Recorded, numbers: Any = ()) -> Recorded:
        """Append an operation on all elements, of inputs that are broadcast."""
        shape = torch.broadcast_shapes(*(x.shape for x in inputs))
        inputs = tuple(x.expand(shape) for x in inputs)
        return self.emit(code, shape, inputs, shape.numel(), numbers) if shape.numel() else inputs[0]

    def placed(self, values: Any) -> int:
        """Store constants, equal ones once, and return their place."""
        array, first = torch.as_tensor(values, dtype=torch.float32).detach().flatten().numpy(), 0
        for known in self.numbers:
            if np.array_equal(known, array):
                return first
            first += len(known)
        self.numbers.append(array)
        return first

    def arrange(self, kept: Sequence[Recorded]) -> int:
        """Let registers that are not needed at the same time share their place, and return the size of a frame.

        Args:
            kept: Inputs and outputs, which keep a place of their own.
        """
        begins, sizes = np.array(self.begins), np.diff(self.begins)

        def register_of(places: Any) -> np.ndarray:
            return np.searchsorted(begins, np.asarray(places), "right") - 1

        life = {int(r): [0, len(self.ops)] for x in kept for r in np.unique(register_of(x.place))}
        for i, op in enumerate(self.ops):
            for r in np.unique(np.concatenate([register_of(x).ravel() for x in (op["out"], *op["reads"])])):
                life.setdefault(int(r), [i, i])[1] = max(i, life.get(int(r), [0, 0])[1])
        place, done = np.zeros(len(begins), np.int64), list[int]()
        for r, (born, last) in sorted(life.items(), key=lambda item: item[1][0]):
            for other in sorted(done, key=place.__getitem__):
                apart = life[other][1] < born or last < life[other][0]
                if not apart and place[other] < place[r] + sizes[r] and place[r] < place[other] + sizes[other]:
                    place[r] = -(-(place[other] + sizes[other]) // _ALIGNED) * _ALIGNED
            done.append(r)

        def moved(places: Any) -> Any:
            return np.asarray(places) + (place - begins)[register_of(places)]

        for op in self.ops:
            op |= {name: int(moved(op[name])) for name in ("out", "a", "b") if name in op}
        for x in kept:
            x.place = torch.from_numpy(moved(x.place))
        self.indices = moved(np.array(self.indices, np.int64)).tolist()
        return int((place[done] + sizes[done]).max()) + _ALIGNED


def _linear(x: Recorded, weight: Tensor, bias: Tensor | None = None) -> Recorded:
    outputs, inputs = weight.shape
    step = -(-outputs // PANEL) * PANEL
    out = x.tape.emit(LINEAR, (*x.shape[:-1], step), [x], inputs, step=step, matrix=(weight, bias))
    return out[..., :outputs]


def _rms_norm(x: Recorded, shape: Sequence[int], weight: Tensor, eps: float) -> Recorded:
    return x.tape.emit(NORM, x.shape, [x], shape[0], torch.cat([weight, weight.new_tensor([eps])]))


def _embedding(ids: Recorded, table: Tensor, **_: Any) -> Recorded:
    return ids.tape.emit(EMBED, (*ids.shape, table.shape[1]), [ids], ids.place.numel(), table, step=table.shape[1])


def _joined(join: Callable[..., Tensor]) -> Callable[..., Recorded]:
    return lambda parts, dim=0: Recorded(parts[0].tape, join([part.place for part in parts], dim))


_FUNCTIONS: dict[Any, Callable[..., Any]] = {
    F.linear: _linear,
    F.rms_norm: _rms_norm,
    F.embedding: _embedding,
    F.silu: lambda x, inplace=False: x.tape.elementwise(SILU, x),
    torch.tanh: lambda x: x.tape.elementwise(TANH, x),
    torch.cat: _joined(torch.cat),
    torch.stack: _joined(torch.stack),
}
