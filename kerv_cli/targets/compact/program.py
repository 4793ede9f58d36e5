"""Run a torch module on a CPU as a `Program`: operations that are recorded once and executed by one compiled call.

A program computes in *frames*: the float32 memory of one row of a batch. A *place* is the index of a number in a frame.
`recording.py` explains both, and how a module becomes a table of operations. `compile_parts` makes the programs of a
module, once the module's weights are final.

numba compiles the kernels when they are first used on a machine. It stores the machine code in NUMBA_CACHE_DIR if that
is set, else in `__pycache__`. If this folder cannot be written, numba takes the user's cache folder. If that cannot be
written either, kerv chooses a temporary folder that only this user can write.
"""

from __future__ import annotations

import fcntl
import functools
import logging
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Self, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.weak import WeakIdKeyDictionary

from kerv_cli.base.files import own_folder
from kerv_cli.engine.protocol import Seen
from kerv_cli.targets.attention import Cache
from kerv_cli.targets.checkpoint import load_state
from kerv_cli.targets.compact.recording import ARGMAX, BFLOAT, BLOCKED, BRANCH, COLUMNS, FLOAT, HALF, INT8, PANEL, Tape

_LOG = logging.getLogger("kerv")
LARGE = 2**19  # weights of a bfloat16 matrix from which on oneDNN's layout saves more than a call of oneDNN costs
ROWS = 32  # oneDNN chooses the layout for this many rows; 154 M weights take 27 ms for 1 row, 33 for 31, 41 for 47


@functools.lru_cache(maxsize=1)
def kernels() -> ModuleType:
    """Return the module of compiled kernels.

    The first process on a machine compiles the kernels, which takes fifteen seconds. Meanwhile other processes wait.
    """
    import numba
    from numba.core import event

    class Told(event.Listener):
        def on_start(self, event: Any) -> None:
            if event.data["dispatcher"].py_func.__name__ == "run":
                _LOG.warning("compiling for this CPU, once: about fifteen seconds …")

        def on_end(self, event: Any) -> None:
            pass

    mine = own_folder()
    with open(mine / "lock", "w", encoding="ascii") as lock, event.install_listener("numba:compile", Told()):
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            from kerv_cli.targets.compact import kernels
        except RuntimeError:  # numba finds no folder that it can write to
            numba.config.CACHE_DIR = str(mine)
            from kerv_cli.targets.compact import kernels
    return kernels


@functools.lru_cache(maxsize=1)
def multiplies_bfloat16() -> bool:
    """Return whether this CPU (by AMX or AVX512-BF16) and torch multiply bfloat16 matrices in blocked layout."""
    supported = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return bool(supported) and bool(torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported())


class Blocked:
    """The weights (outputs, inputs) of a linear layer in bfloat16, in oneDNN's blocked layout.

    One token and thirty tokens take almost the same time, because most time is spent on reading the weights. All other
    operations of a program stay float32: in bfloat16 they would save little time, and the two best logits would be
    almost equal more often. oneDNN adds in a different order for one token than for many, so the last bit of a result
    depends on the number of tokens (docs/measuring.md).
    """

    def __init__(self, weight: Tensor, bias: Tensor | None) -> None:
        self.weight = torch.ops.mkldnn._reorder_linear_weight(weight.contiguous(), ROWS)
        self.bias = None if bias is None else bias.to(torch.bfloat16)

    def __call__(self, x: Tensor) -> Tensor:
        x = x.to(torch.bfloat16)
        return torch.ops.mkldnn._linear_pointwise(x, self.weight, self.bias, "none", [], "")


class Matrix:
    """The weights of a linear layer, stored in panels. A panel holds the weights of 64 outputs side by side.

    The number format of float32 weights is the smallest that holds them without loss: int8 with a scale per output,
    float16 or float32. Large bfloat16 matrices are stored in oneDNN's layout if the CPU multiplies bfloat16.

    Args:
        weight: (outputs, inputs) float32 or bfloat16.
        bias: (outputs,) float32. None means zeros.

    Attributes:
        values: (panels, inputs, PANEL) weights.
        factors: (panels, 2, PANEL) scale and bias of every output.
        columns: What the table of operations holds for this matrix, by column (`recording.COLUMNS`).
        blocked: The matrix in oneDNN's layout, without panels. None if the matrix is stored in panels.
    """

    def __init__(self, weight: Tensor, bias: Tensor | None) -> None:
        outputs, inputs = weight.shape
        self.blocked, self.nbytes = None, weight.nbytes
        if weight.dtype == torch.bfloat16 and weight.numel() >= LARGE and multiplies_bfloat16():
            self.blocked, self.columns = Blocked(weight, bias), {"kind": BLOCKED, "panels": outputs}
            return
        steps = weight.abs().amax(1, keepdim=True).div(127).clamp_min(1e-30)  # the scales of `checkpoint.compact`
        whole, scale, panels = (weight / steps).round(), torch.ones(outputs), -(-outputs // PANEL)
        # zeros would fit into int8, but a grown layer's zeros must cost as much as trained weights
        if weight.dtype == torch.bfloat16:
            kind, values = BFLOAT, weight.view(torch.int16)
        elif weight.any() and torch.equal(whole * steps, weight):
            kind, values, scale = INT8, whole.to(torch.int8), steps[:, 0]
        elif kernels().EXPANDS_HALF and torch.equal(weight.half().float(), weight):
            kind, values = HALF, weight.half()
        else:
            kind, values = FLOAT, weight
        bias = torch.zeros(outputs) if bias is None else bias.float()
        rest, factors = panels * PANEL - outputs, torch.stack([scale, bias])
        self.values = F.pad(values, (0, 0, 0, rest)).view(panels, PANEL, inputs).transpose(1, 2).contiguous()
        self.factors = F.pad(factors, (0, rest)).view(2, panels, PANEL).transpose(0, 1).contiguous()
        places = {"weights": self.values.data_ptr(), "factors": self.factors.data_ptr()}
        self.columns = {"panels": panels, "kind": kind, **places}
        self.nbytes = outputs * inputs * self.values.element_size()


_MATRICES = WeakIdKeyDictionary()  # weight tensor -> `Matrix`, which programs with the same layer share


def stored_bytes(tensors: Iterable[Tensor]) -> float:
    return float(sum(_MATRICES.get(x, x).nbytes for x in tensors))


_WITHOUT_ATTENTION = Cache(1, 1, 1, 1, 1, torch.empty(0))
NOTHING = -1  # no result, or no token that ends a repetition
_CAUSAL = np.zeros((0, 1), np.float32)  # the mask of causal attention
_FIRST = np.zeros(1, np.int64)  # positions of a program without attention


class Program:
    """A compiled function of tensors."""

    def __init__(self, function: Callable[..., Any], *shapes: Sequence[int], repeats: bool = False) -> None:
        """Record a function as a table of operations.

        Args:
            function: Takes tensors and returns a tensor or a tuple of tensors. All of them are float32 in the program.
            shapes: Shape of each input. Its first dimension is 1 and stands for any number of rows.
            repeats: Whether `repeat` or `grow` will be called. Then output i of an execution becomes input i of the
                next execution. There may be more outputs than inputs.
        """
        tape = Tape()
        with torch.no_grad():
            inputs = list(map(tape.register, shapes))
            found = function(*inputs)
        outputs = [tape.lined(x, x.shape[-1]) for x in (found if isinstance(found, tuple) else (found,))]
        if repeats:
            for given, (result, _, _) in zip(inputs, outputs, strict=False):
                tape.copied(result, given)
        self.size, self.cache = tape.arrange([*inputs, *(x for x, _, _ in outputs)]), tape.cache
        self.places = [(x.first, x.place.numel()) for x in inputs]
        self.results = [(x.first, rows, stride, x.shape[1:]) for x, rows, stride in outputs]
        self.matrices: list[Matrix] = []
        self.blocked: list[tuple[int, Blocked, list[tuple[slice, slice]]]] = []
        for i, op in enumerate(tape.ops):
            if "matrix" in op:
                weight, bias = op["matrix"]
                if weight not in _MATRICES:
                    _MATRICES[weight] = Matrix(weight.detach(), bias)
                matrix: Matrix = _MATRICES[weight]
                self.matrices.append(matrix)
                op |= matrix.columns
                if matrix.blocked is not None:
                    self.blocked.append((i, matrix.blocked, _columns_of(op)))
        self.ops = np.array([[op.get(name, 0) for name in COLUMNS] for op in tape.ops], np.int64)
        self.indices = np.array(tape.indices, np.int64)
        self.numbers = np.concatenate([*tape.numbers, np.zeros(1, np.float32)])
        found = np.flatnonzero(np.isin(self.ops[:, 0], (ARGMAX, BRANCH)))
        self.last = int(found[0]) + 1 if len(found) else len(self.ops)
        self.run = kernels().run

    def __call__(
        self, *inputs: Tensor, positions: Tensor | None = None, cache: Cache | None = None, seen: Seen = None
    ) -> list[Tensor]:
        """Compute the outputs, (rows, …) each.

        Args:
            inputs: (rows, …). If the program has attention, (B, T, …): B sequences of T tokens, which are B · T rows.
            positions: (T,) rotary positions. None if the program has no attention.
            cache: The keys and values of the new tokens are written after the cached ones, but `cache.length` stays as
                it is.
            seen: Attention mask (T, M) bool over the last M tokens, as in `attention_mask`. None: causal attention.
        """
        hidden = _CAUSAL
        if seen is not None:
            tokens, last = seen.shape
            hidden = np.zeros((tokens, (cache.length if cache is not None else 0) + tokens), np.float32)
            np.logical_not(np.asarray(seen), out=hidden[:, hidden.shape[1] - last :])
        frames = self._execute(inputs, _FIRST if positions is None else positions.numpy(), cache, hidden)
        found = []
        for first, rows, stride, shape in self.results:
            if rows == 1:
                block = frames[:, first : first + shape[-1]]
            else:
                block = frames[:, first : first + rows * stride].reshape(len(frames), rows, stride)[:, :, : shape[-1]]
                block = np.ascontiguousarray(block)
            found.append(torch.from_numpy(block).view(-1, *shape))
        return found

    def repeat(self, times: int, *inputs: Tensor, cache: Cache, end: int | None = None) -> np.ndarray:
        """Execute the program several times in one call. The outputs of one execution are the inputs of the next.

        Args:
            inputs: Inputs of the first execution: one token for each of B sequences.
            cache: Each execution appends the keys and values of one more token, but `cache.length` stays as it is.
            end: Stop after an execution whose result for the first sequence is this token. If None, never stop early.

        Returns:
            (executions, B) float32, the result of the ARGMAX operation in each execution.
        """
        results = np.full((times, 1, inputs[0].numel() // self.places[0][1]), NOTHING, np.float32)
        self._execute(inputs, np.array([cache.length]), cache, _CAUSAL, results, end)
        return results[: cache.copied - cache.length, 0]

    def grow(
        self, levels: int, top_k: int, nodes: int, *inputs: Tensor, position: int, cache: Cache
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draft EAGLE-2's dynamic tree in one call. Every execution of the program adds a level.

        At each level, the `top_k` nodes with the highest cumulative log-probability get `top_k` children each. In the
        end the most probable nodes of all levels are kept. Of equally probable nodes the first ones are kept.

        Args:
            levels: Maximum number of tokens on a path.
            nodes: Maximum number of nodes of the tree.
            inputs: Inputs of the program for the tree's root.
            position: Rotary position of the tree's first level.
            cache: The keys and values of drafted tokens are written after the cached ones, but `cache.length` stays as
                it is.

        Returns:
            Tokens (n,), parents (n,) with −1 for the root, and the mask (n, n) bool: entry [i, j] says whether node j
                is node i or one of its ancestors.
        """
        results = np.empty((levels, 4, top_k * top_k), np.float32)
        hidden = np.ones((top_k, cache.length + levels * top_k), np.float32)
        hidden[:, : cache.length] = 0.0
        rows = [x.expand(top_k, *x.shape[1:]) for x in inputs]
        self._execute(rows, np.full(top_k, position), cache, hidden, results)
        return kernels().best(results, top_k, nodes)

    def _execute(
        self,
        inputs: Sequence[Tensor],
        positions: np.ndarray,
        cache: Cache | None,
        hidden: np.ndarray,
        results: np.ndarray | None = None,
        end: int | None = None,
    ) -> np.ndarray:
        """Execute the program len(results) times, or once without `results`. Return the frames (rows, size).

        Args:
            hidden: (T, slots) float32, 0 for slots that a token sees. `_CAUSAL` if attention is causal.
            results: (times, 1, B) float32, or (levels, 4, top_k²) for `grow`. It is filled with the results of each
                execution.
        """
        rows, tokens = inputs[0].numel() // self.places[0][1], len(positions)
        results = np.empty((1, 1, rows), np.float32) if results is None else results
        times = len(results)
        frames = np.empty((rows, self.size), np.float32)
        for (first, size), value in zip(self.places, inputs, strict=True):
            plain = value.float() if value.dtype == torch.bfloat16 else value
            frames[:, first : first + size] = plain.numpy().reshape(rows, size)
        if cache is None:
            layers, heads, channels = self.cache
            like = torch.empty(0)
            cache = Cache(layers, rows // tokens, heads, tokens, channels, like) if layers else _WITHOUT_ATTENTION
        start, (buffer, keys, values, filled) = cache.length, cache.copies(PANEL)
        stop = start + tokens * times
        if stop > buffer.shape[4]:
            raise IndexError(f"{tokens * times} tokens after {start} in a cache of {buffer.shape[4]}")
        rest = frames, positions, start, buffer, keys, values, filled, hidden, results
        stop_at = NOTHING if end is None else end
        if self.blocked:
            self._alternate(times, stop_at, *rest)
        else:
            self.run(self.ops, 0, times, self.last, self.indices, self.numbers, *rest, stop_at)
        cache.copied = stop if end is None else start + tokens * int((results[:, 0, 0] != NOTHING).sum())
        return frames

    def _alternate(self, times: int, end: int, frames: np.ndarray, *rest: Any) -> None:
        # one compiled call executes all operations between two multiplications by oneDNN
        memory, run = torch.from_numpy(frames), self.run
        positions, start, buffer, keys, values, filled, hidden, results = rest
        for time in range(times):
            begin, stop = 0, self.last if time == times - 1 else len(self.ops)
            held = start + time * len(positions) if time else filled
            rest = frames, positions, start, buffer, keys, values, held, hidden, results
            for i, matrix, rows in self.blocked:
                if i < stop:
                    run(self.ops[begin:i], time, time + 1, i - begin, self.indices, self.numbers, *rest, NOTHING)
                    for given, result in rows:
                        memory[:, result] = matrix(memory[:, given])
                    begin = i + 1
            run(self.ops[begin:stop], time, time + 1, stop - begin, self.indices, self.numbers, *rest, NOTHING)
            if end != NOTHING and results[time, 0, 0] == end:
                return


def _columns_of(op: dict[str, Any]) -> list[tuple[slice, slice]]:
    # two slices of a frame for each row of a large matrix's input: the row's input and the row's result
    columns = []
    for row in range(op["rows"]):
        a, out = op["a"] + row * op["stride"], op["out"] + row * op["step"]
        columns.append((slice(a, a + op["width"]), slice(out, out + op["panels"])))
    return columns


M = TypeVar("M", bound=nn.Module)


class Compilable(nn.Module):
    """A module that can be compiled for a CPU while its weights are frozen.

    If the module is moved or unfrozen, or weights are loaded into it, the compiled form is discarded and torch computes
    as usual. A copy has no compiled form. After changing weights in any other way (`parameter.data`, a submodule's own
    `load_state_dict`), call `compile_parts` again.
    """

    compiled: Any = None

    def new_program(self) -> Any:
        """Return the compiled form of this module, for `compile_parts`. None if the module cannot be compiled."""
        return None

    def runs_compiled(self, *inputs: Tensor) -> bool:
        """Return whether a compiled form exists, no gradients are needed, and nothing is being recorded."""
        for x in inputs:
            if not isinstance(x, Tensor) or (x.requires_grad and torch.is_grad_enabled()):
                return False
        return self.compiled is not None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "compiled": None}  # it contains memory addresses or a session of ONNX Runtime

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.compiled = None
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *arguments: Any, **keywords: Any) -> None:
        self.compiled = None
        super()._load_from_state_dict(*arguments, **keywords)

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        for part in self.modules():
            if requires_grad and isinstance(part, Compilable):
                part.compiled = None
        return super().requires_grad_(requires_grad)


class CompilableLinear(Compilable, nn.Linear):
    """A linear layer that is compiled by itself, not as a part of a larger module. An example is an output head."""

    def new_program(self) -> Program:
        return Program(super().forward, (1, self.in_features))

    def forward(self, x: Tensor) -> Tensor:
        return self.compiled(x)[0].view(*x.shape[:-1], -1) if self.runs_compiled(x) else super().forward(x)


def compile_parts(module: nn.Module) -> None:
    """Compile every `Compilable` submodule of a module, and set the submodule's attribute `compiled`.

    Nothing happens unless all parameters are frozen, on a CPU, and all in float32 or all in bfloat16.
    """
    kinds = {(p.device.type, p.dtype, p.requires_grad) for p in module.parameters()}
    if kinds not in ({("cpu", torch.float32, False)}, {("cpu", torch.bfloat16, False)}):
        return
    for parameter in module.parameters():
        _MATRICES.pop(parameter, None)  # the weights may have changed
    parts = [part for part in module.modules() if isinstance(part, Compilable)]
    for part in parts:
        part.compiled = None
    for part in parts:
        part.compiled = part.new_program()


def load_compiled(module: M, folder: Path, kind: str, device: str | torch.device, dtype: torch.dtype) -> M:
    """Load the weights in a folder into a module. Move it to a device, freeze it, and on a CPU compile it."""
    load_state(module, folder, kind)
    module = module.to(device=device, dtype=dtype).eval().requires_grad_(False)
    compile_parts(module)
    return module
