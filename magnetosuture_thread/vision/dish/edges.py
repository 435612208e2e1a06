"""Compiled loops over the edges of an image: thinning, votes for the centres of circles, support of ellipses."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.sampling import within


@compiled
def thin_edges(along_u, along_v, strength, minimum, edges):
    """Fill in the points whose gradient is greatest along its own direction.

    Args:
        along_u: gradient along u, shape (rows, columns).
        along_v: gradient along v.
        strength: its length.
        minimum: that it has at least.
        edges: filled with u, v and the gradient's unit direction, shape (n, 4).

    Returns:
        How many there are, at most n.
    """
    rows, columns = strength.shape
    count = 0
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            value = strength[row, column]
            if value < minimum:
                continue
            x, y = along_u[row, column] / value, along_v[row, column] / value
            step_u, step_v = int(np.rint(x)), int(np.rint(y))
            if value < strength[row + step_v, column + step_u] or value <= strength[row - step_v, column - step_u]:
                continue
            if count == len(edges):
                return count
            edges[count, 0], edges[count, 1], edges[count, 2], edges[count, 3] = column, row, x, y
            count += 1
    return count


@compiled
def vote(edges, smallest, largest, origin, cell, votes):
    """Let each edge vote for the centres of the circles that it may be of: both ways along its gradient.

    Args:
        edges: see `thin_edges`.
        smallest: radius [px].
        largest: radius [px].
        origin: u and v of the first cell's corner [px].
        cell: side of a cell [px].
        votes: counted up, shape (rows, columns).
    """
    rows, columns = votes.shape
    count = int((largest - smallest) / cell) + 1
    for index in range(len(edges)):
        for sign in (-1.0, 1.0):
            for step in range(count):
                r = sign * (smallest + step * cell)
                column = int((edges[index, 0] + r * edges[index, 2] - origin[0]) / cell)
                row = int((edges[index, 1] + r * edges[index, 3] - origin[1]) / cell)
                if 0 <= row < rows and 0 <= column < columns:
                    votes[row, column] += 1.0


@compiled
def ring_support(edges, centre, smallest, ratio, alignment, directions):
    """Mark in which directions from a centre, and in which rings of radii, there are edges that face it.

    Args:
        edges: see `thin_edges`.
        centre: u and v [px].
        smallest: radius of the first ring [px].
        ratio: of a ring's outer radius to its inner one.
        alignment: least cosine between gradient and direction.
        directions: filled, shape (rings, directions).
    """
    rings, bins = directions.shape
    scale = 1.0 / math.log(ratio)
    for index in range(len(edges)):
        x, y = edges[index, 0] - centre[0], edges[index, 1] - centre[1]
        r = math.hypot(x, y)
        if r < smallest or abs(x * edges[index, 2] + y * edges[index, 3]) < alignment * r:
            continue
        ring = int(math.log(r / smallest) * scale)
        if ring < rings:
            directions[ring, int((math.atan2(y, x) / (2.0 * math.pi) + 1.0) * bins) % bins] = 1


@compiled
def fit_harmonics(angles, radii, tolerance, tries, bins, best):
    """Find by random samples the ellipse near a centre that edges in the most directions agree on.

        r(t) = c_0 + c_1 cos t + c_2 sin t + c_3 cos 2t + c_4 sin 2t

    Args:
        angles: of the edges from the centre, shape (m,) [rad].
        radii: of them [px].
        tolerance: between an edge and the ellipse [px].
        tries: how many samples of five edges are drawn.
        bins: directions that are counted.
        best: filled with c, shape (5,).

    Returns:
        In how many directions an edge agrees.
    """
    count = len(angles)
    basis = np.empty((count, 5))
    sector = np.empty(count, np.int64)
    for index in range(count):
        t = angles[index]
        basis[index, 0] = 1.0
        basis[index, 1], basis[index, 2] = math.cos(t), math.sin(t)
        basis[index, 3], basis[index, 4] = math.cos(2.0 * t), math.sin(2.0 * t)
        sector[index] = int((t / (2.0 * math.pi) + 1.0) * bins) % bins
    state, most = np.uint64(88172645463325252), 0
    picked = np.empty(5, np.int64)
    for _ in range(tries):
        apart = True
        for k in range(5):
            state ^= (state << np.uint64(13)) & np.uint64(0xFFFFFFFFFFFFFFFF)
            state ^= state >> np.uint64(7)
            state ^= (state << np.uint64(17)) & np.uint64(0xFFFFFFFFFFFFFFFF)
            picked[k] = np.int64((state >> np.uint64(11)) % np.uint64(count))
            for other in range(k):
                apart = apart and abs(sector[picked[k]] - sector[picked[other]]) > 2
        if not apart:
            continue
        system, right = np.empty((5, 5)), np.empty(5)
        for k in range(5):
            right[k] = radii[picked[k]]
            for j in range(5):
                system[k, j] = basis[picked[k], j]
        if abs(np.linalg.det(system)) < 1e-3:
            continue
        shape = np.linalg.solve(system, right)
        if math.hypot(shape[1], shape[2]) > 0.2 * shape[0] or math.hypot(shape[3], shape[4]) > 0.12 * shape[0]:
            continue
        marks = np.zeros(bins, np.uint8)
        for index in range(count):
            fitted = 0.0
            for j in range(5):
                fitted += basis[index, j] * shape[j]
            if abs(radii[index] - fitted) < tolerance:
                marks[sector[index]] = 1
        agreeing = int(marks.sum())
        if agreeing > most:
            most = agreeing
            best[:] = shape
    return most


@compiled
def steepest(gray, points, normals, reach, step, sign, found):
    """Find the steepest rise or fall of an image along normals.

    Args:
        gray: shape (rows, columns), uint8.
        points: where the normals begin, shape (n, 2) [px].
        normals: unit vectors, shape (n, 2).
        reach: how far to look to both sides [px].
        step: between samples [px].
        sign: 1 for rises, -1 for falls, 0 for both.
        found: filled with the offset along the normal [px] and the slope there, shape (n, 2); a slope of 0: none.
    """
    count = 2 * int(reach / step) + 1
    profile = np.empty(count)
    half = count // 2
    for index in range(len(points)):
        found[index, 1] = 0.0
        u, v = points[index]
        if u < 1.0 or v < 1.0 or u > gray.shape[1] - 2.0 or v > gray.shape[0] - 2.0:
            continue
        for k in range(count):
            s = (k - half) * step
            profile[k] = within(gray, u + s * normals[index, 0], v + s * normals[index, 1])
        best, at = 0.0, -1
        for k in range(2, count - 2):
            slope = (2.0 * (profile[k + 2] - profile[k - 2]) + profile[k + 1] - profile[k - 1]) / (10.0 * step)
            score = abs(slope) if sign == 0 else sign * slope
            if score > best:
                best, at = score, k
        if at < 3 or at > count - 4:
            continue
        near = np.empty(3)
        for j in range(3):
            k = at - 1 + j
            near[j] = abs(2.0 * (profile[k + 2] - profile[k - 2]) + profile[k + 1] - profile[k - 1]) / (10.0 * step)
        bend = near[0] - 2.0 * near[1] + near[2]
        part = 0.5 * (near[0] - near[2]) / bend if bend < 0.0 else 0.0
        found[index, 0] = (at - half + part) * step
        found[index, 1] = (profile[at + 1] - profile[at - 1]) / (2.0 * step)
