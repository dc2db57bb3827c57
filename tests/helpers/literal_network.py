"""The integer network in Python's own integers."""

import math

from qrl.export.kernel import Dense, Kernel


def limited(value: int, least: int, most: int) -> int:
    return min(max(value, int(least)), int(most))


def literal_tanh(z: int) -> int:
    place, part = (z + 2**15) // 2**8, (z + 2**15) % 2**8
    low, high = (round(math.tanh(-6.0 + 12.0 * (place + k) / 256) * 32767) for k in (0, 1))
    return low + ((high - low) * part + 128) // 256


def literal_dense(layer: Dense, x: list[int]) -> list[int]:
    """The sums, scaled and within 16 bits."""
    y = []
    for o in range(len(layer.bias)):
        acc = int(layer.bias[o])
        for i in range(len(x)):
            acc += int(layer.weight[o, i]) * x[i]
        assert abs(acc) < 2**31
        y.append(limited(acc * int(layer.multiplier[o]) // 2 ** (16 + layer.shift), -(2**15), 2**15 - 1))
    return y


def literal_network(kernel: Kernel, x: list[int], h: list[int]) -> tuple[list[int], list[int]]:
    """The next numbers of a recurrent unit, and the action in steps."""
    for layer in kernel.layers[:-1]:
        relu = kernel.activation == "relu"
        x = [max(z, 0) if relu else literal_tanh(z) for z in literal_dense(layer, x)]
    if unit := kernel.unit:
        g = [(value + 2**unit.memory_shift // 2) // 2**unit.memory_shift for value in h]
        gates = literal_dense(unit.gates, x + g)
        i, m = literal_dense(unit.of_input, x), literal_dense(unit.of_memory, g)
        after = []
        for k in range(len(h)):
            r, z = ((literal_tanh(gates[at]) + 32768) // 2 for at in (k, len(h) + k))
            total = (i[k] + (r * m[k] + 2**14) // 2**15) * 2**unit.shift
            n = literal_tanh(limited(total, -(2**15), 2**15 - 1))
            after.append(n + ((h[k] - n) * z + 2**14) // 2**15)
        x = h = after
    y = literal_dense(kernel.layers[-1], x)
    return h, [limited(z, least, most) for z, least, most in zip(y, kernel.act_min, kernel.act_max, strict=True)]
