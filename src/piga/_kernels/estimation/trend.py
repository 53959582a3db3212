"""A straight line through values with an excess variance, and this line for every day of a history.

Both variances solve Paule and Mandel's condition: the weighted residual sum equals its degrees of freedom. Newton's
method is applied to the reciprocal of the sum, which is nearly linear in the variance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import Array, kernel

Index = NDArray[np.int64]

STEPS = 100
"""Most Newton steps; three to six are usual."""
RESOLUTION = 1e-9
"""Relative size of the last Newton step; the error left is of the order of its square."""


class Points(NamedTuple):
    """Times, values and their variances, (n,) each."""

    t: Array
    y: Array
    v: Array


@kernel
def newton_step(total: float, change: float, freedom: int) -> float:
    """Step of the variance towards ``total = freedom``; ``change`` is the derivative of ``total``, below zero."""
    return total * (freedom - total) / (freedom * change)


@kernel
def inner_sum(y: Array, v: Array, first: Index, days: int, excess: float) -> tuple[float, float]:
    """Weighted residual sum about the weighted mean of each day, and its derivative by the excess variance."""
    total, slope = 0.0, 0.0
    for day in range(days):
        start, stop = first[day], first[day + 1]
        if stop - start < 2:
            continue
        weight, mean = 0.0, 0.0
        for i in range(start, stop):
            w = 1.0 / (v[i] + excess)
            weight += w
            mean += w * (y[i] - y[start])
        mean = y[start] + mean / weight
        for i in range(start, stop):
            w = 1.0 / (v[i] + excess)
            part = w * (y[i] - mean) ** 2
            total += part
            slope -= w * part
    return total, slope


@kernel
def inner_excess(y: Array, v: Array, first: Index, days: int, freedom: int, start: float) -> float:
    """Variance within days beyond the stated one; ``start`` is a first guess."""
    guess = max(start, 0.0)
    for _ in range(STEPS):
        total, slope = inner_sum(y, v, first, days, guess)
        if slope == 0.0:
            return 0.0
        step = newton_step(total, slope, freedom)
        if step < 0.0 and guess == 0.0:
            return 0.0
        new = max(guess + step, 0.0)
        if abs(new - guess) <= RESOLUTION * new:
            return new
        guess = new
    return guess


@kernel
def merge_days(
    values: Points, first: Index, days: int, within: float, merged: Points, start_day: int = 0
) -> None:
    """Mean time, weighted mean and its variance of each day from ``start_day`` on, written to ``merged``."""
    t, y, v = values
    for day in range(start_day, days):
        start, stop = first[day], first[day + 1]
        weight, mean, when = 0.0, 0.0, 0.0
        for i in range(start, stop):
            w = 1.0 / (v[i] + within)
            weight += w
            mean += w * (y[i] - y[start])
            when += t[i] - t[start]
        merged.t[day] = t[start] + when / (stop - start)
        merged.y[day] = y[start] + mean / weight
        merged.v[day] = 1.0 / weight


@kernel
def line_through(
    t: Array, y: Array, v: Array, n: int, excess: float, weights: Array, out: Array
) -> tuple[float, float]:
    """Weighted line through the first ``n`` values; returns the residual sum and its derivative by the excess.

    ``weights`` takes the weights. ``out`` (5,) takes mean time, mean value, slope, sum of the weights, and their
    second moment about the mean time.
    """
    weight, when, mean = 0.0, 0.0, 0.0
    for i in range(n):
        w = 1.0 / (v[i] + excess)
        weights[i] = w
        weight += w
        when += w * (t[i] - t[0])
        mean += w * (y[i] - y[0])
    when, mean = t[0] + when / weight, y[0] + mean / weight
    moment, product = 0.0, 0.0
    for i in range(n):
        lever = (t[i] - when) * weights[i]
        moment += lever * (t[i] - when)
        product += lever * (y[i] - mean)
    slope = product / moment
    total, change = 0.0, 0.0
    for i in range(n):
        w = weights[i]
        part = w * (y[i] - mean - slope * (t[i] - when)) ** 2
        total += part
        change -= w * part
    out[0], out[1], out[2], out[3], out[4] = when, mean, slope, weight, moment
    return total, change


@kernel
def line_excess(t: Array, y: Array, v: Array, n: int, start: float, weights: Array, out: Array) -> float:
    """Variance about the line beyond the stated one; ``weights`` and ``out`` as in :func:`line_through`."""
    guess = max(start, 0.0)
    for _ in range(STEPS):
        total, change = line_through(t, y, v, n, guess, weights, out)
        if change == 0.0:
            return 0.0
        step = newton_step(total, change, n - 2)
        if step < 0.0 and guess == 0.0:
            return 0.0
        new = max(guess + step, 0.0)
        if abs(new - guess) <= RESOLUTION * new:
            return new
        guess = new
    return guess


@kernel
def days_so_far(
    t: Array, y: Array, v: Array, first: Index, shared: Array, least: int, figures: Array, known: Array
) -> None:
    """The line through the days before each day from ``least`` on, and through all of them.

    Parameters
    ----------
    t, y, v:
        (n,) times, values and own variances, day by day.
    first:
        (days + 1,) where each day begins, and the end.
    shared:
        (sources, n) errors common to the records.
    least:
        Fewest days for a line.
    figures:
        (days + 1 - least, 11) out: variance inside days, the five of :func:`line_through`, excess, residual sum with
        the stated variances and with the excess, mean and median variance of a day. Row ``d - least`` is for the
        first ``d`` days.
    known:
        (days + 1 - least, 2, sources) out: mean and slope of the shared errors.
    """
    days, sources = first.size - 1, shared.shape[0]
    time, means, variances = np.empty(days), np.empty(days), np.empty(days)
    values, means_of_days = Points(t, y, v), Points(time, means, variances)
    merged, ordered, weights, line = np.empty((days, sources)), np.empty(days), np.empty(days), np.empty(5)
    within, excess, done = 0.0, 0.0, 0
    for count in range(least, days + 1):
        freedom = first[count] - count
        if freedom > 0:
            before = within
            within = inner_excess(y, v, first, count, freedom, within)
            if within != before:
                done = 0  # another variance inside days: every day is merged again
        merge_days(values, first, count, within, means_of_days, done)
        merge_shared(v, first, count, within, shared, merged, done)
        insert_sorted(variances, ordered, count, done)
        done = count
        row = figures[count - least]
        row[7] = line_through(time, means, variances, count, 0.0, weights, line)[0]
        excess = line_excess(time, means, variances, count, excess, weights, line)
        row[8] = line_through(time, means, variances, count, excess, weights, line)[0]
        row[0], row[1:6], row[6] = within, line, excess
        row[9] = variances[:count].mean()
        row[10] = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
        level, slope = known[count - least, 0], known[count - least, 1]
        level[:], slope[:] = 0.0, 0.0
        for day in range(count):
            w = weights[day]
            lever = w * (time[day] - line[0])
            for source in range(sources):
                level[source] += w * merged[day, source]
                slope[source] += lever * merged[day, source]
        level /= line[3]
        slope /= line[4]


@kernel
def merge_shared(
    v: Array, first: Index, days: int, within: float, shared: Array, merged: Array, start_day: int
) -> None:
    """Weighted mean (days, sources) of the shared errors (sources, n) of each day from ``start_day`` on."""
    for day in range(start_day, days):
        for source in range(shared.shape[0]):
            weight, total = 0.0, 0.0
            for i in range(first[day], first[day + 1]):
                w = 1.0 / (v[i] + within)
                weight += w
                total += w * shared[source, i]
            merged[day, source] = total / weight


@kernel
def insert_sorted(values: Array, ordered: Array, count: int, start: int) -> None:
    """Keep the first ``count`` values in rising order; those before ``start`` are there already."""
    if start == 0:
        ordered[:count] = np.sort(values[:count])
        return
    for new in range(start, count):
        place = new
        while place > 0 and ordered[place - 1] > values[new]:
            ordered[place] = ordered[place - 1]
            place -= 1
        ordered[place] = values[new]
