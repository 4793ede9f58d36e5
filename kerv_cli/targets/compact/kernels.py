"""Kernels that execute a recorded `Program` on one CPU core. numba compiles `run` and everything that it calls.

- A *frame* is the float32 memory of one row of a batch. Operations read and write it. A *place* is an index in a frame.
- A *panel* is a block of 64 outputs of a weight matrix, whose weights are stored side by side.
- Weights stay in their stored format (half precision, or int8 and a scale per output). They become float32 in the CPU's
  vector registers. All sums are float32.

The result of a row has the same bits whether it is computed alone or with other rows. For this, a matrix multiplication
adds its terms in the order of the inputs, one output per vector lane, and a softmax does not depend on slots that are
hidden from the row. A verification of 16 tokens therefore gives exactly the logits of 16 single forwards. So strict
acceptance gives the tokens of autoregressive decoding even if two logits are almost equal. This matters: the logits of
these kernels and of torch differ by up to 2e-5 (mt10-vision), and for 1 of 2,550 tokens the two best logits are closer
than 4e-5. Such a token may be decoded differently on two types of CPU.

Measured on an AMD EPYC (Zen 5), 3.5 M weights with 192 inputs: 1 row 0.06 ms, 16 rows 0.42 ms, 31 rows 0.84 ms. oneDNN
takes 0.78 ms and 1.21 ms for 16 and 31 rows, OpenBLAS 1.19 ms and 2.44 ms.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic

from kerv_cli.targets.compact import recording as op
from kerv_cli.targets.compact.recording import BFLOAT, FLOAT, HALF, INT8, PANEL

FEATURES = (numba.config.CPU_FEATURES or get_host_cpu_features()).split(",")
# whether the CPU converts float16 to float32 in registers; if not, float16 weights are stored as float32
EXPANDS_HALF = "+f16c" in FEATURES or platform.machine() in ("aarch64", "arm64")
# outputs computed at once for two to six rows; all sums must fit into the vector registers
LANES = PANEL if "+avx512f" in FEATURES else 16
FAST = {"contract", "reassoc", "nsz"}
compiled = numba.njit(error_model="numpy", fastmath=FAST)
NUMBER, WORD, LANE, VOID, ADDRESS = ir.FloatType(), ir.IntType(64), ir.IntType(32), types.void, types.intp


def _tile(rows: int, kind: int, lanes: int) -> Callable[..., None]:
    """Generate the innermost loop of a matrix multiplication: y = (x · weights) · scale + bias.

    The loop multiplies `rows` rows of x by `lanes` columns of one panel. All sums stay in registers. `kind` is the
    number format of the weights.

    Returns:
        A function of (weights, factors, inputs, x, stride, y, step). Four of these are memory addresses: of the weights
            (inputs, PANEL), of the factors (2, PANEL; scales, then biases), of x, and of y. `inputs` is the number of
            inputs. The rows of x are `stride` bytes apart, those of y `step` bytes.
    """
    formats = {HALF: (ir.HalfType(), 2), INT8: (ir.IntType(8), 1), FLOAT: (NUMBER, 4), BFLOAT: (ir.IntType(16), 2)}
    stored, size = formats[kind]
    vector, fused = ir.VectorType(NUMBER, lanes), {"flags": ("contract",)}
    words = ir.VectorType(LANE, lanes)
    nothing, zeros, upper = ir.Constant(vector, ir.Undefined), ir.Constant(words, [0] * lanes), [16] * lanes

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        weights, factors, inputs, x, stride, y, step = arguments

        def pointer(base: Any, index: Any, distance: Any, kind: Any) -> Any:
            return builder.inttoptr(builder.add(base, builder.mul(index, distance)), kind.as_pointer())

        def load(base: Any, index: Any, distance: int, kind: Any, align: int = 4) -> Any:
            value = builder.load(pointer(base, index, WORD(distance), kind))
            value.align = align
            return value

        places = [builder.add(x, builder.mul(stride, WORD(r))) for r in range(rows)]
        before, loop, after = builder.block, builder.append_basic_block(), builder.append_basic_block()
        builder.branch(loop)
        builder.position_at_end(loop)
        index, sums, totals = builder.phi(WORD), [builder.phi(vector) for _ in range(rows)], []
        row = load(weights, index, PANEL * size, ir.VectorType(stored, lanes), size)
        following = builder.add(index, WORD(1))
        if kind == BFLOAT:  # the upper half of a float32 number
            row = builder.bitcast(builder.shl(builder.zext(row, words), ir.Constant(words, upper)), vector)
        elif kind != FLOAT:
            row = (builder.fpext if kind == HALF else builder.sitofp)(row, vector)
        for place, total in zip(places, sums, strict=True):
            single = builder.insert_element(nothing, load(place, index, 4, NUMBER), LANE(0))
            term = builder.fmul(row, builder.shuffle_vector(single, nothing, zeros), **fused)
            totals.append(builder.fadd(total, term, **fused))
        starts = [WORD(0), *[ir.Constant(vector, [0.0] * lanes)] * rows]
        for value, start, change in zip([index, *sums], starts, [following, *totals], strict=True):
            value.add_incoming(start, before)
            value.add_incoming(change, loop)
        builder.cbranch(builder.icmp_signed("<", following, inputs), loop, after)
        builder.position_at_end(after)
        scale, bias = (load(factors, WORD(i), 4 * PANEL, vector) for i in range(2))
        for r, total in enumerate(totals):
            result = builder.fadd(builder.fmul(total, scale, **fused), bias, **fused)
            builder.store(result, pointer(y, WORD(r), step, vector)).align = 4
        return context.get_dummy_value()

    return intrinsic(lambda typing, weights, factors, inputs, x, stride, y, step: (VOID(*[ADDRESS] * 7), generate))


def _product(kind: int, size: int) -> Callable[..., None]:
    # the arguments of `_tile` for any number of rows and all panels; `size` is in bytes
    one, two, three, four, five, six = (_tile(n, kind, LANES if n > 1 else PANEL) for n in range(1, 7))

    @compiled
    def product(weights, factors, inputs, panels, x, stride, rows, y, step):
        groups = (rows + 5) // 6  # as equal as can be: 8 rows are 4 and 4, not 6 and 2
        for panel in range(panels):
            w, f, to = weights + size * PANEL * inputs * panel, factors + 8 * PANEL * panel, y + 4 * PANEL * panel
            if rows == 1:
                one(w, f, inputs, x, stride, to, step)
            else:
                for c in range(0, PANEL, LANES):
                    r, wide, narrow = 0, w + size * c, f + 4 * c
                    for group in range(groups):
                        at, place = x + r * stride, to + r * step + 4 * c
                        many = (rows - r) // (groups - group)
                        r += many
                        if many == 6:
                            six(wide, narrow, inputs, at, stride, place, step)
                        elif many == 5:
                            five(wide, narrow, inputs, at, stride, place, step)
                        elif many == 4:
                            four(wide, narrow, inputs, at, stride, place, step)
                        elif many == 3:
                            three(wide, narrow, inputs, at, stride, place, step)
                        else:
                            two(wide, narrow, inputs, at, stride, place, step)

    return product


half_product = _product(HALF, 2) if EXPANDS_HALF else _product(FLOAT, 4)
int8_product, bfloat_product, product = _product(INT8, 1), _product(BFLOAT, 2), _product(FLOAT, 4)


def _read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.load(builder.gep(builder.inttoptr(arguments[0], NUMBER.as_pointer()), [arguments[1]]))


def _write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    builder.store(arguments[2], builder.gep(builder.inttoptr(arguments[0], NUMBER.as_pointer()), [arguments[1]]))
    return context.get_dummy_value()


def _shift(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    exponent = builder.shl(builder.add(builder.fptosi(arguments[1], LANE), LANE(127)), LANE(23))
    return builder.fmul(arguments[0], builder.bitcast(exponent, NUMBER))


# `get` reads and `put` writes the float32 number at `index` in an array that begins at memory address `address`
get = intrinsic(lambda typing, address, index: (types.float32(ADDRESS, ADDRESS), _read))
put = intrinsic(lambda typing, address, index, value: (VOID(ADDRESS, ADDRESS, types.float32), _write))
# x · 2^power for an integer power from −126 to 127
times_two_to = intrinsic(lambda typing, x, power: (types.float32(types.float32, types.float32), _shift))

_LOG2_E, _LN_2, _LN_2_REST = np.float32(math.log2(math.e)), np.float32(0.693359375), np.float32(-2.12194440e-4)
_T2, _T3, _T4, _T5, _T6, _T7 = (np.float32(1 / math.factorial(n)) for n in range(2, 8))
_ZERO, _ONE, _TWO, _LOWEST = np.float32(0), np.float32(1), np.float32(2), np.float32(-1e30)


@compiled
def exponential(x):
    """Return e^x with an error of two or three units in the last place. Loops that call it can be vectorised."""
    x = min(max(x, np.float32(-87)), np.float32(88))
    power = np.rint(x * _LOG2_E)
    x = (x - power * _LN_2) - power * _LN_2_REST
    value = (((((_T7 * x + _T6) * x + _T5) * x + _T4) * x + _T3) * x + _T2) * x * x + x + _ONE
    return times_two_to(value, power)


@compiled
def copy(x, to, count):
    for i in range(count):
        put(to, i, get(x, i))


@compiled
def rotate(x, to, cos, sin, channels):
    """Apply rotary position embedding to one head of one token.

    All arguments but `channels` are addresses. In the first half of the channels the sign of the sines is reversed.
    """
    half = channels // 2
    for c in range(half):
        first, second = get(x, c), get(x, c + half)
        put(to, c, first * get(cos, c) + second * get(sin, c))
        put(to, c + half, second * get(cos, c + half) + first * get(sin, c + half))


@numba.njit(error_model="numpy", fastmath=FAST - {"reassoc"} | {"nnan"})
def softmax(scores, slots, scale, mask, stop):
    """Turn attention scores into weights, in place. Hidden slots get exactly 0, whatever their scores are.

    The sum of the weights is computed in 16 parts, so that hidden slots do not change the rounding.

    Args:
        scores: Address of the scores, one per slot of the cache.
        mask: Address of a number per slot. A slot is hidden if its number is not 0. The address 0 hides no slot.
        stop: Slots from this index on are hidden.
    """
    for s in range(stop, slots):
        put(scores, s, _LOWEST)
    if mask:
        for s in range(stop):
            put(scores, s, get(scores, s) if get(mask, s) == 0 else _LOWEST)
    most, total = _LOWEST, _ZERO
    for s in range(slots):
        most = max(most, get(scores, s))
    for s in range(slots):
        score = get(scores, s)
        weight = exponential((score - most) * scale)
        put(scores, s, weight if score > _LOWEST else _ZERO)
    for i in range(16):
        part = _ZERO
        for s in range(i, slots, 16):
            part += get(scores, s)
        total += part
    for s in range(stop):
        put(scores, s, get(scores, s) / total)


@compiled
def attention(frames, out, qkv, tables, cache, start, filled, mask, keys, values):
    """Compute one layer's attention for T new tokens of B sequences, and append their keys and values to the cache.

    Args:
        frames: (B · T, size), one frame (memory) per token.
        out: Place (index in a frame) of the result, E numbers.
        qkv: Place of queries, keys and values, 3 E numbers, not yet rotated.
        tables: (T, 2, C) rotary cosines and sines of the tokens' positions.
        cache: (2, B, A, slots, C) keys and values of this layer, for A heads of C channels.
        start: Number of valid slots in the cache. The new tokens get the next T slots.
        filled: Number of slots that are already copied to `keys` and `values`.
        mask: (T, start + T or more), 0 for slots that a token sees. Shape (0, 1) means that attention is causal.
        keys: (B · A, panels, C, PANEL) copy of the cached keys, a matrix from channels to slots.
        values: (B · A, panels, slots, PANEL) copy of the cached values, a matrix from slots to channels.
    """
    tokens, heads, channels = tables.shape[0], cache.shape[2], tables.shape[2]
    stop, size, parts = start + tokens, 4 * frames.shape[1], values.shape[1]
    panels = (stop + PANEL - 1) // PANEL
    queries, scores = np.empty((tokens, channels), np.float32), np.empty((tokens, panels * PANEL), np.float32)
    result, factors = np.empty((tokens, parts * PANEL), np.float32), np.zeros((panels + parts, 2, PANEL), np.float32)
    factors[:, 0] = _ONE
    q, weights, mixed, one = queries.ctypes.data, scores.ctypes.data, result.ctypes.data, factors.ctypes.data
    table, row, scale = 4 * channels, 4 * panels * PANEL, _ONE / np.sqrt(np.float32(channels))
    for head in range(len(frames) // tokens * heads):
        b, h = head // heads, head % heads
        first = frames.ctypes.data + b * tokens * size + h * table
        k, v = cache[0, b, h].ctypes.data, cache[1, b, h].ctypes.data
        for t in range(tokens):
            x, turn, slot = first + t * size + 4 * qkv, tables[t].ctypes.data, (start + t) * table
            rotate(x, q + t * table, turn, turn + table, channels)
            rotate(x + heads * table, k + slot, turn, turn + table, channels)
            copy(x + 2 * heads * table, v + slot, channels)
        for s in range(filled, stop):
            panel = keys[head, s // PANEL].ctypes.data + 4 * (s % PANEL)
            for c in range(channels):
                put(panel, c * PANEL, get(k + s * table, c))
            for part in range(parts):
                to = values[head, part, s].ctypes.data
                copy(v + s * table + 4 * PANEL * part, to, min(PANEL, channels - PANEL * part))
        product(keys[head].ctypes.data, one, channels, panels, q, table, tokens, weights, row)
        for t in range(tokens):
            seen, last = (mask[t].ctypes.data, stop) if len(mask) else (0, start + t + 1)
            softmax(weights + t * row, panels * PANEL, scale, seen, last)
        for part in range(parts):
            to = mixed + 4 * PANEL * part
            product(values[head, part].ctypes.data, one, stop, 1, weights, row, tokens, to, 4 * parts * PANEL)
        for t in range(tokens):
            copy(mixed + 4 * t * parts * PANEL, first + t * size + 4 * out, channels)


@compiled
def sum_of_exponentials(x, most):
    total = _ZERO
    for i in range(len(x)):
        total += exponential(x[i] - most)
    return total


@compiled
def choose(frame, columns, numbers):
    """Choose the tokens of a chunk, and estimate the probability that all are accepted, like `early.network.choose`.

    `frame` (size,) holds the logits, and afterwards the result. `numbers` holds 1 for each token that must equal the
    target's token, else 0.
    """
    out, a, rows, width, stride, first = columns[1], columns[2], columns[4], columns[5], columns[6], columns[7]
    radius, odds = int(frame[columns[3]]), _ONE
    probability, below = np.empty(width, np.float32), np.zeros(width + 1, np.float32)
    for r in range(rows):
        logits, strict, total, best, most = frame[a + r * stride :], numbers[first + r] > 0, 0.0, 0, _LOWEST
        highest = logits[:width].max()
        factor = _ONE / sum_of_exponentials(logits[:width], highest)
        for i in range(width):
            probability[i] = exponential(logits[i] - highest) * factor
        for i in range(width):
            total += probability[i]
            below[i + 1] = total
        for i in range(width):
            score = logits[i]
            if radius and not strict:
                near = below[min(i + radius + 1, width)] - below[max(i - radius, 0)]
                nearer = below[min(i + radius // 3 + 1, width)] - below[max(i - radius // 3, 0)]
                score = near + np.float32(0.1) * nearer + np.float32(0.05) * probability[i]
            if score > most:
                best, most = i, score
        near = below[min(best + radius + 1, width)] - below[max(best - radius, 0)]
        odds *= probability[best] if strict else near
        frame[out + r] = best
    frame[out + rows] = odds


@compiled
def elementwise(code, frame, columns, numbers, indices):
    """Execute one operation on one frame, in place. LINEAR, ATTEND and BRANCH are executed by `run` instead.

    `columns` is the operation's row in the table of operations (`recording.COLUMNS`).
    """
    out, a, b = columns[1], columns[2], columns[3]
    rows, width, stride, first = columns[4], columns[5], columns[6], columns[7]
    size = rows * width
    y, x, z = frame[out : out + size], frame[a:], frame[b : b + size]
    if code == op.GATHER:
        for i in range(size):
            y[i] = frame[indices[first + i]]
    elif code == op.ADD:
        for i in range(size):
            y[i] = x[i] + z[i]
    elif code == op.MULTIPLY:
        for i in range(size):
            y[i] = x[i] * z[i]
    elif code == op.AFFINE:
        factor, offset = numbers[first : first + size], numbers[first + size : first + 2 * size]
        for i in range(size):
            y[i] = x[i] * factor[i] + offset[i]
    elif code == op.CLAMP:
        for i in range(size):
            y[i] = min(max(x[i], numbers[first]), numbers[first + 1])
    elif code == op.SILU:
        for i in range(size):
            y[i] = x[i] / (_ONE + exponential(-x[i]))
    elif code == op.TANH:
        for i in range(size):
            y[i] = _ONE - _TWO / (exponential(_TWO * x[i]) + _ONE)
    elif code == op.EMBED:
        for i in range(size):
            begin, to, wide = first + columns[8] * int(x[i]), out + columns[8] * i, columns[8]
            frame[to : to + wide] = numbers[begin : begin + wide]
    elif code == op.ARGMAX:
        y[0] = np.float32(np.argmax(x[:width]))
    elif code == op.CHOOSE:
        choose(frame, columns, numbers)
    elif code == op.NORM:
        gain, epsilon = numbers[first : first + width], numbers[first + width]
        for r in range(rows):
            row, total = x[r * stride : r * stride + width], _ZERO
            for i in range(width):
                total += row[i] * row[i]
            factor = _ONE / np.sqrt(total / np.float32(width) + epsilon)
            for i in range(width):
                y[r * width + i] = row[i] * factor * gain[i]


@compiled
def ranked(values, best):
    """Fill `best` (n,) with the indices of the n greatest values, greatest first. Equal values keep their order.

    At least n values must be above minus infinity.
    """
    held, count = np.empty(len(best), np.float32), len(best)
    for i in range(count):
        held[i] = -np.inf
    for i in range(len(values)):
        value, place = values[i], count
        if value > held[count - 1]:
            while place > 0 and value > held[place - 1]:
                place -= 1
            for j in range(count - 1, place, -1):
                held[j], best[j] = held[j - 1], best[j - 1]
            held[place], best[place] = value, i


@numba.njit(error_model="numpy", fastmath=FAST - {"reassoc"})
def branch(frames, columns, time, start, mask, results):
    """Grow a level of EAGLE-2's tree: choose the k children of each of the k nodes, and the k best of all children.

    The best children become the nodes that the k frames stand for. In the first execution all frames stand for the
    tree's root, so that only the first frame counts.

    Args:
        frames: (k, size), one frame per node. It holds the logits of the node's children, and the node's hidden state.
        time: Number of earlier executions.
        start: Slot of the first drafted node in the cache.
        mask: (k, slots), 0 for slots that a node sees. Afterwards 0 for slots that the new nodes see.
        results: (times, 4, k²). This call fills `results[time]`. The first three of its four rows hold, for each child
            in this level, the token, the parent, and the sum of the log-probabilities on the child's path. The fourth
            row holds the indices of the k best children in this level. A parent is an index among the children of all
            levels so far, or −1 for the root. The first level has only k children.
    """
    nodes, out, a, b = len(frames), columns[1], columns[2], columns[3]
    width, hidden, rows = columns[5], columns[6], nodes if time else 1
    best, values, seen = np.empty(nodes, np.int64), np.empty(width, np.float32), np.empty_like(mask)
    slots = mask.shape[1]
    copy(mask.ctypes.data, seen.ctypes.data, mask.size)
    for row in range(rows):
        logits, parent, score = frames[row, a : a + width], -1, _ZERO
        if time:
            known = int(results[time - 1, 3, row])
            parent, score = (nodes * nodes * (time - 2) + nodes if time > 1 else 0) + known, results[time - 1, 2, known]
        most = logits.max()
        rest = np.log(sum_of_exponentials(logits, most))
        for i in range(width):
            values[i] = ((logits[i] - most) - rest) + score
        ranked(values, best)
        for i in range(nodes):
            child = row * nodes + i
            results[time, 0, child], results[time, 1, child] = best[i], parent
            results[time, 2, child] = values[best[i]]
    ranked(results[time, 2, : rows * nodes], best)
    for node in range(nodes):
        child, row = best[node], best[node] // nodes
        results[time, 3, node], frames[node, out] = child, results[time, 0, child]
        copy(frames[row, b:].ctypes.data, frames[node, out + 1 :].ctypes.data, hidden)
        copy(seen[row].ctypes.data, mask[node].ctypes.data, slots)
        mask[node, start + nodes * time + node] = _ZERO


_F, _I = types.float32, types.int64
_TABLES = _I[:, ::1], _I, _I, _I, _I[::1], _F[::1]
_COPIES = _F[:, :, :, :, ::1], _F[:, :, :, :, ::1], _I
_ALL = _F[:, ::1], _I[::1], _I, _F[:, :, :, :, :, ::1], *_COPIES, _F[:, ::1], _F[:, :, ::1], _I
SIGNATURE = types.void(*_TABLES, *_ALL)


@numba.njit(SIGNATURE, error_model="numpy", fastmath=FAST, cache=True)
def run(
    ops, begin, end, last, indices, numbers, frames, positions, start, cache, keys, values, filled, mask, results, stop
):
    """Execute a table of operations on all frames, `end` − `begin` times.

    After each execution the rotary positions grow by 1, and the number of cached tokens grows by T. In the shapes,
    `times` is the number of executions of all calls together.

    Args:
        ops: (operations, columns) int64, see `recording.COLUMNS`.
        begin: Number of executions in earlier calls.
        end: Number of executions after this call, earlier calls included.
        last: Number of operations in the last execution. Operations that only prepare a further execution are left out.
        indices: Places (indices in a frame) that GATHER operations copy from.
        frames: (B · T, size) float32, one frame (memory) per row. They hold the inputs, and afterwards the outputs.
        positions: (T,) rotary positions in execution 0, even if this call begins with a later execution.
        start: Number of valid slots in the cache before execution 0, even if this call begins with a later execution.
        cache: (layers, 2, B, A, slots, C) keys and values. New keys and values are appended.
        keys: (layers, B · A, panels, C, PANEL) copy of the keys, see `attention`.
        values: (layers, B · A, panels, slots, PANEL) copy of the values.
        mask: (T, start + T · times), 0 for slots that a row sees. Shape (0, 1) means that attention is causal.
        results: (times, 1, B · T), row i filled with the result of ARGMAX in execution i. For programs that draft a
            tree (times, 4, k²), filled by `branch`.
        stop: Stop after the execution whose result for the first row equals `stop`. If negative, execute until `end`.
    """
    rows, size = frames.shape
    tokens, memory, channels = len(positions), frames.ctypes.data, cache.shape[5]
    tables = np.empty((tokens, 2, channels), np.float32)
    for time in range(begin, end):
        for i in range(last if time == end - 1 else len(ops)):
            columns = ops[i]
            code, out, a, lines, width = columns[0], columns[1], columns[2], columns[4], columns[5]
            if code == op.LINEAR:
                weights, factors, panels, kind = columns[9], columns[10], columns[11], columns[12]
                many, each, stride, step = lines, rows, 4 * columns[6], 4 * columns[8]
                if lines == 1:  # one row per frame: multiply those of all frames together
                    many, each, stride, step = rows, 1, 4 * size, 4 * size
                for r in range(each):
                    x, y = memory + 4 * (r * size + a), memory + 4 * (r * size + out)
                    if kind == HALF:
                        half_product(weights, factors, width, panels, x, stride, many, y, step)
                    elif kind == INT8:
                        int8_product(weights, factors, width, panels, x, stride, many, y, step)
                    elif kind == BFLOAT:
                        bfloat_product(weights, factors, width, panels, x, stride, many, y, step)
                    else:
                        product(weights, factors, width, panels, x, stride, many, y, step)
            elif code == op.ATTEND:
                for t in range(tokens):
                    first = columns[7] + 2 * channels * (positions[t] + time)
                    tables[t] = numbers[first : first + 2 * channels].reshape(2, channels)
                layer, now = columns[6], start + time * tokens
                known, copied = min(layer, len(keys) - 1), now if time > begin else filled
                attention(frames, out, a, tables, cache[layer], now, copied, mask, keys[known], values[known])
            elif code == op.BRANCH:
                branch(frames, columns, time, start, mask, results)
            else:
                for r in range(rows):
                    elementwise(code, frames[r], columns, numbers, indices)
                    if code == op.ARGMAX:
                        results[time, 0, r] = frames[r, out]
        if stop >= 0 and results[time, 0, 0] == stop:
            break


@numba.njit(
    types.Tuple((_I[::1], _I[::1], types.boolean[:, ::1]))(_F[:, :, ::1], _I, _I), error_model="numpy", cache=True
)
def best(results, top_k, nodes):
    """Choose the most probable nodes as EAGLE-2's draft tree. Of equally probable nodes, the first ones are chosen.

    The chosen nodes form a tree, because a child is never more probable than its parent and comes after it.

    Args:
        results: (times, 4, k²), filled by `branch` in all executions.

    Returns:
        The n nodes' tokens (n,) and parents (n,), −1 for the root, and the mask (n, n) bool: entry [i, j] says whether
            node j is node i or one of its ancestors.
    """
    children = results.shape[2]
    count = top_k + (results.shape[0] - 1) * children
    nodes = min(nodes, count)
    chosen, index, scores = np.empty(nodes, np.int64), np.empty(count, np.int64), np.empty(count, np.float32)
    tokens, parents, seen = np.empty(nodes, np.int64), np.empty(nodes, np.int64), np.empty((nodes, nodes), np.bool_)
    for i in range(count):
        level, child = (0, i) if i < top_k else ((i - top_k) // children + 1, (i - top_k) % children)
        scores[i], index[i] = results[level, 2, child], -1
    ranked(scores, chosen)
    for i in chosen:
        index[i] = 0
    node = 0
    for i in range(count):
        if index[i] == 0:
            level, child = (0, i) if i < top_k else ((i - top_k) // children + 1, (i - top_k) % children)
            parent = index[int(results[level, 1, child])] if level else -1
            tokens[node], parents[node], index[i] = int(results[level, 0, child]), parent, node
            for j in range(nodes):
                seen[node, j] = j == node or (parent >= 0 and seen[parent, j])
            node += 1
    return tokens, parents, seen
