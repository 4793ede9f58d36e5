"""Record the computation of a torch module as a table of operations, so that a network is defined once, in torch.

The module runs once on `Recorded` values, which stand for tensors. Every operation on them is appended to a tape.

- A *frame* is the float32 memory of one row of a batch: all inputs, intermediate values and outputs of that row.
- A *place* is the index of one number in a frame.
- A *register* is a contiguous range of places that holds the elements of one tensor.
- A *tape* is the list of the operations that were recorded so far, with their constants.
- A *panel* is a block of 64 outputs of a weight matrix, whose weights are stored together.

A `Recorded` value knows the place of each of its elements. A view (slice, reshape, concatenation) only selects or
reorders these places. Everything else becomes an operation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

# codes of the operations
LINEAR, NORM, SILU, TANH, ADD, MULTIPLY, AFFINE, CLAMP, GATHER, EMBED, ARGMAX, ATTEND, BRANCH, CHOOSE = range(14)
# formats of weights: float16, int8 with a scale per output, float32, bfloat16, and bfloat16 in oneDNN's layout
HALF, INT8, FLOAT, BFLOAT, BLOCKED = range(5)
PANEL = 64  # outputs in a panel; a matrix is stored panel by panel
# columns of the table of operations, all int64; a column that an operation does not use is 0
#   code: the operation, LINEAR to CHOOSE
#   out, a, b: place of the first element of the result, of the first input and of the second input
#   rows, width: number of rows of the input, and of elements per row
#   stride: distance between two input rows in elements; ATTEND: the layer's index in the cache; BRANCH: size of a
#       hidden state
#   first: index of the operation's first constant in `Tape.numbers`; GATHER: of its first entry in `Tape.indices`
#   step: distance between two result rows in elements
#   weights, factors: memory addresses of a matrix's weights, and of its scales and biases
#   panels: number of panels of the matrix; BLOCKED: of outputs
#   kind: number format of the weights, HALF to BLOCKED
COLUMNS = ["code", "out", "a", "b", "rows", "width", "stride", "first", "step", "weights", "factors", "panels", "kind"]
_ALIGNED = 16  # registers begin at multiples of this place
_VIEWS = frozenset({"view", "flatten", "unflatten", "chunk", "split", "expand"})


class Recorded:
    """Stand-in for a float32 tensor of batch size 1 on a CPU. Operations on it are recorded, not computed.

    Attributes:
        place: Integer tensor. It holds the index of each element in the float32 memory (frame) of one batch row.
    """

    requires_grad = is_cuda = False
    dtype, device = torch.float32, torch.device("cpu")

    def __init__(self, tape: Tape, place: Tensor) -> None:
        self.tape, self.place, self.shape = tape, place, place.shape

    @property
    def first(self) -> int:
        return int(self.place.flatten()[0])

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
        """Return self · factor + offset. `factor` and `offset` are numbers, or constant tensors that broadcast."""
        factor, offset = torch.as_tensor(factor, dtype=torch.float32), torch.as_tensor(offset, dtype=torch.float32)
        place, factor, offset = torch.broadcast_tensors(self.place, factor, offset)
        numbers = torch.cat([factor.flatten(), offset.flatten()])
        return self.tape.elementwise(AFFINE, Recorded(self.tape, place), numbers=numbers)

    def clamp(self, low: float, high: float) -> Recorded:
        return self.tape.elementwise(CLAMP, self, numbers=[low, high])

    def mean(self, dim: int) -> Recorded:
        assert dim == 1
        first, *others = self.split(1, 1)
        return (sum(others, start=first) / self.shape[1])[:, 0]

    def argmax(self, dim: int) -> Recorded:
        assert dim == -1
        return self.tape.emit(ARGMAX, (1,), [self], self.place.numel())

    def branch(self, hidden: Recorded) -> tuple[Recorded, Recorded]:
        """Record the operation that grows one level of a draft tree; see `Program.grow`.

        Each row of the batch stands for one node of the tree. `self` holds the logits of the node's children, and
        `hidden` (…, E) the node's hidden state.

        Returns:
            The token (1,) of the node that the row stands for afterwards, and the hidden state (…, E) of its parent.
        """
        size = hidden.place.numel()
        out = self.tape.emit(BRANCH, (1 + size,), [self, hidden], self.place.numel(), stride=size)
        return out[:1], out[1:].view(hidden.shape)

    def choose(self, radius: Recorded, strict: Tensor) -> Recorded:
        """Record the choice of a chunk's tokens from the logits `self` (1, N, V), see `early.network.choose`.

        Args:
            radius: (1, 1) acceptance radius, in bins.
            strict: (N,) bool, tokens that must equal the target's.

        Returns:
            (1, N + 1): the N tokens, then the estimated probability that all of them are accepted.
        """
        return self.tape.emit(CHOOSE, (1, len(strict) + 1), [self, radius], self.shape[-1], strict)

    def attend(self, heads: int, cos: Tensor, sin: Tensor) -> Recorded:
        """Record the attention of the next layer. `self` has 3 E columns: E for queries, E for keys, E for values.

        Args:
            cos: (positions, 1, C) rotary cosines, for every position that can occur.
            sin: (positions, 1, C) rotary sines.
        """
        tape, width = self.tape, self.shape[-1] // 3
        layer, tables = tape.cache[0], torch.cat([cos, sin], 1)
        tape.cache = layer + 1, heads, width // heads
        return tape.emit(ATTEND, (*self.shape[:-1], width), [self], 3 * width, tables, stride=layer)


class Tape:
    """The operations that were recorded so far, and their constants.

    Attributes:
        ops: One dictionary per operation, with the names in COLUMNS as keys.
        numbers: Constant arrays, such as norm gains.
        indices: Places of the elements that GATHER operations copy: those of the first such operation, then those of
            the second, and so on.
        begins: First place of each register. The last entry is the first place of the next register.
        cache: Three numbers for the cache: layers with attention, heads of a layer, channels of a head.
    """

    def __init__(self) -> None:
        self.ops: list[dict[str, Any]] = []
        self.numbers: list[np.ndarray] = []
        self.indices: list[int] = []
        self.begins = [0]
        self.cache = 0, 1, 1

    def register(self, shape: Sequence[int]) -> Recorded:
        first, size = self.begins[-1], int(np.prod(shape))
        self.begins.append(first + size + 1)  # one unused place, so that `lined` never takes two registers for one
        return Recorded(self, torch.arange(first, first + size).view(*shape))

    def emit(
        self,
        code: int,
        out: Recorded | Sequence[int],
        inputs: Sequence[Recorded],
        width: int,
        numbers: Any = (),
        **columns: Any,
    ) -> Recorded:
        """Append an operation, and return its result.

        Args:
            out: Value that receives the result, or the shape of a new register for the result.
            inputs: One or two values that the operation reads. The first value is read in rows of `width` elements. The
                second value is read as one row with all its elements, whatever its shape is.
            numbers: Constants that the operation reads, such as a norm's gain.
            **columns: Further entries of the operation, with the names in COLUMNS.
        """
        out = out if isinstance(out, Recorded) else self.register(out)
        x, rows, stride = self.lined(inputs[0], width)
        op = {"code": code, "out": out.first, "a": x.first, "rows": rows, "width": width, "stride": stride}
        reads = [x.place]
        for x in inputs[1:]:
            second, _, _ = self.lined(x, x.place.numel())
            op["b"] = second.first
            reads.append(second.place)
        self.ops.append({**op, "first": self.placed(numbers), "reads": reads, **columns})
        return out

    def lined(self, x: Recorded, width: int) -> tuple[Recorded, int, int]:
        """Return `x`, or a copy if its rows of `width` elements are not equally spaced in the frame.

        Returns:
            `x` or its copy, the number of rows, and the distance between the starts of two rows, in elements.
        """
        rows = x.place.reshape(-1, width)
        stride = int(rows[1, 0] - rows[0, 0]) if len(rows) > 1 else width
        if torch.equal(rows, rows[0, 0] + torch.arange(len(rows))[:, None] * stride + torch.arange(width)):
            return x, len(rows), stride
        return self.copied(x, self.register(x.shape)), len(rows), width

    def copied(self, x: Recorded, out: Recorded) -> Recorded:
        places = x.place.flatten().tolist()
        op = {"code": GATHER, "out": out.first, "rows": 1, "width": len(places), "first": len(self.indices)}
        self.ops.append({**op, "reads": [x.place]})
        self.indices += places
        return out

    def elementwise(self, code: int, *inputs: Recorded, numbers: Any = ()) -> Recorded:
        shape = torch.broadcast_shapes(*(x.shape for x in inputs))
        inputs = tuple(x.expand(shape) for x in inputs)
        return self.emit(code, shape, inputs, shape.numel(), numbers) if shape.numel() else inputs[0]

    def placed(self, values: Any) -> int:
        """Store an array of constants, and return the index of its first number. Equal arrays are stored once."""
        array, first = torch.as_tensor(values, dtype=torch.float32).detach().flatten().numpy(), 0
        for known in self.numbers:
            if np.array_equal(known, array):
                return first
            first += len(known)
        self.numbers.append(array)
        return first

    def arrange(self, kept: Sequence[Recorded]) -> int:
        """End a recording: give every tensor its final place in the frame, and return the frame's size in numbers.

        Tensors that are never needed at the same time may share memory, except the inputs and outputs `kept`.
        """
        begins, sizes = np.array(self.begins), np.diff(self.begins)

        def register_of(places: Any) -> np.ndarray:
            return np.searchsorted(begins, np.asarray(places), "right") - 1

        life = {int(r): [0, len(self.ops)] for x in kept for r in np.unique(register_of(x.place))}
        for i, op in enumerate(self.ops):
            used = np.concatenate([np.ravel(op["out"]), *map(np.ravel, op["reads"])])
            for r in np.unique(register_of(used)).tolist():
                life.setdefault(r, [i, i])
                life[r][1] = max(i, life[r][1])
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
            for name in op.keys() & {"out", "a", "b"}:
                op[name] = int(moved(op[name]))
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
    return x.tape.emit(NORM, x.shape, [x], shape[0], torch.cat([weight.float(), torch.tensor([eps])]))


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
