"""A position decoder in plain Python, written from the docstring of `pd4dgs_codec.entropy.positions` alone."""

import struct

PULL_STEPS = [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 512]


class Ans:
    def __init__(self, data):
        self.words, self.at, self.x = struct.unpack(f"<{len(data) // 4}I", data), 0, 0
        while self.at < len(self.words) and self.x < 1 << 32:
            self.refill()

    def refill(self):
        self.x = self.x << 32 | self.words[self.at]
        self.at += 1

    def bit(self, zero):  # zero = 2**24 P(0)
        q = self.x & 0xFFFFFF
        low, high = (0, zero) if q < zero else (zero, 1 << 24)
        self.x = (self.x >> 24) * (high - low) + q - low
        if self.x < 1 << 32 and self.at < len(self.words):
            self.refill()
        return int(low > 0)


class Model:
    """Families from the grandparent to the context; `families` maps a context (tuple) to its three keys."""

    def __init__(self, families):
        self.families, self.counts = families, ({}, {}, {})

    def probability(self, context):
        p = 32768
        for counts, key, w in zip(self.counts, self.families(context), (1, 16, 16), strict=True):
            c0, c1 = counts.get(key, (0, 0))
            p = (65536 * c1 + 256 * w * p) // (c0 + c1 + 256 * w)
        q = max(min(p, 65536 - p), 16)
        k = q.bit_length() - 3
        q = min(((q >> k) << k) + (1 << k >> 1), 32768)
        return q if p < 32768 else 65536 - q

    def count(self, coded):
        for family, counts in enumerate(self.counts):
            touched = set()
            for context, bit in coded:
                key = self.families(context)[family]
                c = counts.setdefault(key, [0, 0])
                c[bit] += 256
                touched.add(key)
            for key in touched:
                t = sum(counts[key])
                if t > 12288:
                    counts[key] = [12288 * c // t for c in counts[key]]

    def decode(self, ans, contexts):
        out = [0] * len(contexts)
        passes = ({0}, {1, 2}, {3, 4, 5, 6}, set(range(7, 16))) if len(contexts) >= 64 else (set(range(16)),)
        for members in passes:
            mine = [i for i in range(len(contexts)) if i % 16 in members]
            p = {i: self.probability(contexts[i]) for i in mine}
            for i in sorted(mine, key=lambda i: (p[i], i)):  # noqa: B023
                out[i] = ans.bit((1 << 24) - 256 * p[i])
            self.count([(contexts[i], out[i]) for i in mine])
        return out


def log8(n):
    return (n**8).bit_length() - 1 if n else 0


def box(grid, cell):
    x, y, z = cell
    return [(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]


def predict(nodes, left, axis, grids):
    """Per node (flag context, side context, upper)."""
    centres = [[(p << (b + 1)) + (1 << b) for p, b in zip(node, left, strict=True)] for node in nodes]
    members = []
    for g, _ in grids:
        held = {}
        for i, c in enumerate(centres):
            held.setdefault(tuple(v >> (g + 1) for v in c), []).append(i)
        members.append(held)
    out = []
    for i, centre in enumerate(centres):
        for (g, _), held in zip(grids[::-1], members[::-1], strict=True):
            near = [j for cell in box(g, [v >> (g + 1) for v in centre]) for j in held.get(cell, ())]
            if len(near) > 7:
                break
        near.remove(i)
        u = [[v << (8 - g) if g <= 8 else v >> (g - 8) for v in centres[j]] for j in (i, *near)]
        out.append(classes([[a - b for a, b in zip(v, u[0], strict=True)] for v in u[1:]], g, left, axis))
    return out


def classes(d, g, left, axis):
    n = len(d)
    n1 = max(n, 1)
    m = [(sum(v[i] for v in d) << 4) // n1 for i in range(3)]
    C = [[((sum(v[i] * v[j] for v in d) << 8) // n1 - m[i] * m[j]) >> 8 for j in range(3)] for i in range(3)]
    for i in range(3):
        C[i][i] += max((1 << 2 * max(9 - g + left[i], 0)) >> 3, 1)
    h, a, b, c = max(8 - g + left[axis], 0), axis, (axis + 1) % 3, (axis + 2) % 3
    A = [0, 0, 0]
    A[a] = C[b][b] * C[c][c] - C[b][c] * C[c][b]
    A[b] = C[b][c] * C[c][a] - C[b][a] * C[c][c]
    A[c] = C[b][a] * C[c][b] - C[b][b] * C[c][a]
    D = max(sum(C[a][j] * A[j] for j in range(3)), 1)
    P = sum(A[j] * m[j] for j in range(3))
    pull = sum(s <= abs(P) // max(D >> h, 1) for s in PULL_STEPS) if n else 0
    sharp = sum(1 << s <= (A[a] << (2 * h + 4)) // D for s in range(9))
    density = min(max((3 * log8(min(n, 4096)) - 16 * (3 * g - sum(left))) // 12 + 30, 0), 39)
    scale = min(max(g - left[axis], 0), 4)
    return (density, sharp, min(pull // 3, 4)), (pull, sharp, scale), int(P > 0)


def decode(payload, count):
    if count == 0:
        return []
    low, depths = struct.unpack_from("<3i", payload), struct.unpack_from("<3B", payload, 12)
    ans = Ans(payload[15:])
    flags = Model(lambda c: ((c[1] // 2, c[2]), (c[0] // 2, c[1] // 2, c[2]), c))
    sides = Model(lambda c: (c[0], (c[0], c[2]), c))
    nodes, grids = [(0, 0, 0)], []
    for level in range(max(depths), 0, -1):
        if not grids or grids[-1][1]:
            held = set(nodes)
            around = sum(cell in held for node in nodes for cell in box(level, node)) - len(nodes)
            grids = [*grids, (level, len(nodes) < 100 or around >= 5 * len(nodes))][-3:]
        for axis in (2, 1, 0):
            both = [0] * len(nodes)
            ones = [0] * len(nodes)
            if level <= depths[axis]:
                left = [level - 1 if a > axis else level for a in range(3)]
                guess = predict(nodes, left, axis, grids)
                if len(nodes) < count:
                    both = flags.decode(ans, [g[0] for g in guess])
                single = [i for i in range(len(nodes)) if not both[i]]
                for i, hit in zip(single, sides.decode(ans, [guess[i][1] for i in single]), strict=True):
                    ones[i] = guess[i][2] if hit else 1 - guess[i][2]
            split = []
            for node, two, one in zip(nodes, both, ones, strict=True):
                for half in (0, 1) if two else (one,):
                    split.append(tuple(2 * p + half if a == axis else p for a, p in enumerate(node)))
            nodes = split
    assert len(nodes) == count and ans.x == 0 and ans.at == len(ans.words)
    return [tuple(p + m for p, m in zip(node, low, strict=True)) for node in nodes]
