"""Statistical methods recomputed by elementary sums, without numpy or scipy.

In place of the Beta and Gamma functions that the lab uses, there are sums of binomial and Poisson tails.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations, product
from statistics import NormalDist
from typing import Any


def student(values: Sequence[float]) -> dict[str, Any] | None:
    """Return number, mean and interval of the values; the interval is None if all are equal."""
    n = len(values)
    if not n:
        return None
    mean = math.fsum(values) / n
    if min(values) == max(values):
        return {"n": n, "mean": mean, "student": None}
    error = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (n - 1) / n)
    half = student_t(n - 1) * error
    return {"n": n, "mean": mean, "student": [mean - half, mean + half]}


def student_t(freedom: int) -> float:
    """Return the two-sided 5 % quantile of t with `freedom` degrees of freedom."""
    angle = solve(lambda a: _within(a, freedom), 0.95, 0.0, math.pi / 2)
    return math.tan(angle) * math.sqrt(freedom)


def _within(angle: float, freedom: int) -> float:
    """Return the probability that a variable with Student's t distribution is between -x and x.

    Here x = tan(angle) sqrt(freedom), and `freedom` is the number of degrees of freedom.
    """
    cosine, sine = math.cos(angle), math.sin(angle)
    term, total = (1.0, 0.0) if freedom % 2 == 0 else (cosine, 0.0)
    for k in range(freedom // 2):
        total += term
        step = (2 * k + 1) / (2 * k + 2) if freedom % 2 == 0 else (2 * k + 2) / (2 * k + 3)
        term *= step * cosine * cosine
    return sine * total if freedom % 2 == 0 else 2 / math.pi * (angle + sine * total)


Z = NormalDist().inv_cdf(0.975)
Ends = list[float]


def solve(rises: Callable[[float], float], wanted: float, low: float, high: float) -> float:
    """Return the argument in [low, high] at which the increasing function `rises` has the `wanted` value, by
    bisection.
    """
    for _ in range(200):
        middle = (low + high) / 2
        if not low < middle < high:
            break  # adjacent floating-point numbers
        low, high = (middle, high) if rises(middle) < wanted else (low, middle)
    return (low + high) / 2


def mass(n: int, p: float) -> list[float]:
    """Return the binomial distribution of `n` trials at rate `p`."""
    if p in (0.0, 1.0):
        return [float(k == (n if p else 0)) for k in range(n + 1)]
    whole = math.lgamma(n + 1)
    return [
        math.exp(
            whole - math.lgamma(k + 1) - math.lgamma(n - k + 1) + k * math.log(p) + (n - k) * math.log1p(-p)
        )
        for k in range(n + 1)
    ]


def wilson(x: int, n: int) -> Ends:
    """Return the rates that a normal test at 5 % does not reject: roots of (x/n - p)^2 = z^2 p (1 - p) / n."""
    a, b, c = 1 + Z * Z / n, -(2 * x / n + Z * Z / n), (x / n) ** 2
    root = math.sqrt(max(0.0, b * b - 4 * a * c))
    return [0.0 if x == 0 else (-b - root) / (2 * a), 1.0 if x == n else (-b + root) / (2 * a)]


def clopper_pearson(x: int, n: int) -> Ends:
    """Return the ends of the 95 % Clopper-Pearson interval of the success rate for x successes in n trials.

    Within the interval, x or fewer successes and x or more successes both have a probability of at least 2.5 %.
    """
    low = 0.0 if x == 0 else solve(lambda p: math.fsum(mass(n, p)[x:]), 0.025, 0.0, 1.0)
    high = 1.0 if x == n else solve(lambda p: -math.fsum(mass(n, p)[: x + 1]), -0.025, 0.0, 1.0)
    return [low, high]


def beta_interval(a: int, b: int) -> Ends:
    """Return the central 95 % of Beta(a, b), whose distribution is a binomial tail of a + b - 1 trials."""

    def share(p: float) -> float:
        return math.fsum(mass(a + b - 1, p)[a:])

    return [solve(share, 0.025, 0.0, 1.0), solve(share, 0.975, 0.0, 1.0)]


def garwood(events: int) -> Ends:
    """Return the exact interval of a Poisson mean."""

    def at_most(k: int, mean: float) -> float:
        if mean <= 0:
            return 1.0
        return math.fsum(math.exp(i * math.log(mean) - mean - math.lgamma(i + 1)) for i in range(k + 1))

    top = 10.0 * (events + 10)
    low = solve(lambda m: 1 - at_most(events - 1, m), 0.025, 0.0, top) if events else 0.0
    return [low, solve(lambda m: -at_most(events, m), -0.025, 0.0, top)]


def newcombe(x1: int, n1: int, x2: int, n2: int) -> Ends:
    """Return the interval of method 10 of Newcombe (1998)."""
    (l1, u1), (l2, u2), p1, p2 = wilson(x1, n1), wilson(x2, n2), x1 / n1, x2 / n2
    down, up = math.hypot(p1 - l1, u2 - p2), math.hypot(u1 - p1, p2 - l2)
    return [max(-1.0, p1 - p2 - down), min(1.0, p1 - p2 + up)]


def barnard(x1: int, n1: int, x2: int, n2: int) -> tuple[float, float]:
    """Return statistic and two-sided p-value of Barnard's test.

    Whether a table is as extreme as the observed one is decided in integers.
    """
    total = n1 + n2

    def square(a: int, b: int) -> tuple[int, int]:
        return (a * n2 - b * n1) ** 2, (a + b) * (total - a - b)

    over, under = square(x1, x2)
    if under == 0:
        return 0.0, 1.0
    z = (x1 / n1 - x2 / n2) / math.sqrt(under / total**2 * (1 / n1 + 1 / n2))
    ends: list[tuple[int, int]] = []  # by row: number of extreme tables at its beginning and at its end
    for a in range(n1 + 1):
        extreme = [
            (square(a, b)[0] * under >= over * square(a, b)[1]) if square(a, b)[1] else over == 0
            for b in range(n2 + 1)
        ]
        first = next((b for b, it in enumerate(extreme) if not it), n2 + 1)
        last = next((b for b, it in enumerate(reversed(extreme)) if not it), 0) if first <= n2 else 0
        ends.append((first, last))

    def tail(angle: float) -> float:
        p = math.sin(angle) ** 2
        first_masses, second_masses = mass(n1, p), mass(n2, p)
        below, above = [0.0], [0.0]
        for k in range(n2 + 1):
            below.append(below[-1] + second_masses[k])
            above.append(above[-1] + second_masses[n2 - k])
        return math.fsum(m * (below[f] + above[e]) for m, (f, e) in zip(first_masses, ends, strict=True))

    return z, min(1.0, _highest(tail, 0.0, math.pi / 2, 300))


def _highest(function: Callable[[float], float], low: float, high: float, parts: int) -> float:
    """Return the maximum of a smooth function between `low` and `high`.

    The function may have several peaks. It is evaluated at `parts` equal steps, and the search is refined around the
    three highest peaks.
    """
    width = (high - low) / parts
    values = [function(low + i * width) for i in range(parts + 1)]
    best = max(values)
    peaks = sorted(
        (i for i in range(1, parts) if values[i] >= max(values[i - 1], values[i + 1])),
        key=lambda i: -values[i],
    )
    for peak in peaks[:3]:
        left, right = low + (peak - 1) * width, low + (peak + 1) * width
        for _ in range(40):
            third = (right - left) / 3
            at_left, at_right = function(left + third), function(right - third)
            best = max(best, at_left, at_right)
            left, right = (left + third, right) if at_left < at_right else (left, right - third)
    return best


def better(x1: int, n1: int, x2: int, n2: int) -> float:
    """Return the probability that the first rate is higher than the second, with uniform priors.

    `x1` of `n1` and `x2` of `n2` trials succeeded. The rates are distributed as Beta(a, b) and Beta(c, d), with a = x1
    + 1, b = n1 - x1 + 1, c = x2 + 1, d = n2 - x2 + 1.
    """
    a, b, c, d = x1 + 1, n1 - x1 + 1, x2 + 1, n2 - x2 + 1

    def log_beta(p: float, q: float) -> float:
        return math.lgamma(p) + math.lgamma(q) - math.lgamma(p + q)

    return min(
        1.0,
        math.fsum(
            math.exp(log_beta(c + i, b + d) - math.log(b + i) - log_beta(1 + i, b) - log_beta(c, d))
            for i in range(a)
        ),
    )


def mcnemar(first_only: int, second_only: int) -> float:
    """Return the two-sided probability that chance splits the discordant pairs at least as unevenly."""
    n = first_only + second_only
    if n == 0:
        return 1.0
    tail = sum(math.comb(n, k) for k in range(min(first_only, second_only) + 1))
    return min(1.0, 2 * tail / 2**n)


def holm(probabilities: Sequence[float]) -> list[float]:
    """Return the probabilities corrected by Holm's procedure, in the given order."""
    n, corrected = len(probabilities), list(probabilities)
    for i, p in enumerate(probabilities):
        smaller = [q for j, q in enumerate(probabilities) if (q, j) <= (p, i)]
        ordered = sorted(smaller)
        corrected[i] = max(min(1.0, (n - rank) * q) for rank, q in enumerate(ordered))
    return corrected


def letters(names: Sequence[str], apart: set[frozenset[str]]) -> dict[str, str]:
    """Return the letters of each name, so that two names share a letter if and only if they are not in `apart`.

    Each letter stands for a maximal group of names without a pair in `apart`. These groups are found by enlarging
    smaller groups by one member at a time.
    """
    groups = {frozenset([name]) for name in names}
    grown = True
    while grown:
        larger = {
            group | {name}
            for group in groups
            for name in names
            if name not in group and not any(frozenset((name, member)) in apart for member in group)
        }
        maximal = {group for group in groups if not any(group < member for member in larger)} | larger
        grown, groups = maximal != groups, maximal
    place = {name: i for i, name in enumerate(names)}
    columns = sorted(groups, key=lambda group: sorted(place[name] for name in group))
    signs = [chr(97 + i % 26) + (str(i // 26) if i >= 26 else "") for i in range(len(columns))]
    return {
        name: "".join(s for s, column in zip(signs, columns, strict=True) if name in column) for name in names
    }


def exact_within(tables: Sequence[tuple[int, int, int, int]]) -> float | None:
    """Return the exact conditional two-sided test of equal arms within strata, by sums of hypergeometric
    probabilities.
    """
    telling = [(x1, n1, x2, n2) for x1, n1, x2, n2 in tables if n1 and n2 and 0 < x1 + x2 < n1 + n2]
    if len(telling) < 2:
        return None
    masses, lowest = [1.0], 0
    for x1, n1, x2, n2 in telling:
        least, own = _hypergeometric(n1, n2, x1 + x2)
        lowest += least
        masses = [
            math.fsum(masses[i - j] * own[j] for j in range(len(own)) if 0 <= i - j < len(masses))
            for i in range(len(masses) + len(own) - 1)
        ]
    observed = masses[sum(table[0] for table in telling) - lowest]
    return min(1.0, math.fsum(mass for mass in masses if mass <= observed * (1 + 1e-9)))


def interaction(tables: Sequence[tuple[int, int, int, int]]) -> float | None:
    """Return Zelen's exact test of a common odds ratio; None if there is nothing, or too much, to enumerate."""
    telling = [(x1, n1, x2, n2) for x1, n1, x2, n2 in tables if n1 and n2 and 0 < x1 + x2 < n1 + n2]
    sizes = sorted(len(_hypergeometric(n1, n2, x1 + x2)[1]) for x1, n1, x2, n2 in telling)
    if len(telling) < 2 or math.prod(sizes[:-1]) > 20_000:
        return None
    wide = max(telling, key=lambda t: len(_hypergeometric(t[1], t[3], t[0] + t[2])[1]))
    telling.remove(wide)
    own = [_hypergeometric(n1, n2, x1 + x2) for x1, n1, x2, n2 in telling]
    least, last = _hypergeometric(wide[1], wide[3], wide[0] + wide[2])
    total = wide[0] + sum(table[0] for table in telling)
    observed = last[wide[0] - least] * math.prod(
        masses[table[0] - low] for table, (low, masses) in zip(telling, own, strict=True)
    )
    tables_masses = []
    for chosen in product(*(range(len(masses)) for _, masses in own)):
        last_index = total - sum(low + at for (low, _), at in zip(own, chosen, strict=True)) - least
        if 0 <= last_index < len(last):
            tables_masses.append(
                last[last_index] * math.prod(masses[at] for (_, masses), at in zip(own, chosen, strict=True))
            )
    return math.fsum(mass for mass in tables_masses if mass <= observed * (1 + 1e-9)) / math.fsum(
        tables_masses
    )


def _hypergeometric(n1: int, n2: int, successes: int) -> tuple[int, list[float]]:
    """Return the probabilities of the first arm's numbers of successes, given `successes` of both arms together.

    The arms have `n1` and `n2` trials. The first return value is the smallest possible number of successes of the first
    arm. The second is the probability of this number and of each larger possible one.
    """
    least, most = max(0, successes - n2), min(n1, successes)
    whole = math.comb(n1 + n2, successes)
    return least, [math.comb(n1, x) * math.comb(n2, successes - x) / whole for x in range(least, most + 1)]


def mantel_haenszel(tables: Sequence[tuple[int, int, int, int]]) -> dict[str, object]:
    """Return the comparison over scenes of (successes, trials, successes, trials) each."""
    surplus = variance = above = below = weighted = weights = 0.0
    for x1, n1, x2, n2 in tables:
        n, x = n1 + n2, x1 + x2
        surplus += x1 - n1 * x / n
        variance += n1 * n2 * x * (n - x) / (n * n * (n - 1))
        above, below = above + x1 * (n2 - x2) / n, below + x2 * (n1 - x1) / n
        weights += n1 * n2 / n
        weighted += n1 * n2 / n * (x1 / n1 - x2 / n2)
    crude = sum(t[0] for t in tables) / sum(t[1] for t in tables) - sum(t[2] for t in tables) / sum(
        t[3] for t in tables
    )
    stratified = weighted / weights
    return {
        "odds_ratio": above / below if below > 0 else None,
        "p": math.erfc(abs(surplus) / math.sqrt(2 * variance)) if variance > 0 else 1.0,
        "crude": crude,
        "stratified": stratified,
        "reversed": crude * stratified < 0 and min(abs(crude), abs(stratified)) > 1e-12,
    }


def success_bets(pairs: Sequence[tuple[bool, bool]]) -> list[float]:
    """Return log e after each pair of outcomes (first, second), for a bet that the second arm is better."""
    log_e, path = 0.0, []
    for t, (worse, better_one) in enumerate(pairs):
        p = (1 + sum(w for w, _ in pairs[:t])) / (3 + t)
        q = (2 + sum(b for _, b in pairs[:t])) / (3 + t)
        if p < q:
            m = (p + q) / 2
            log_e += math.log((p if worse else 1 - p) / (m if worse else 1 - m))
            log_e += math.log((q if better_one else 1 - q) / (m if better_one else 1 - m))
        path.append(log_e)
    return path


def score_bets(differences: Sequence[float]) -> list[float]:
    """Return the log wealth after each difference of scores, of a bet that the mean difference is above 0.

    Five gamblers with equal money and one stake each act as one gambler with the wealth-weighted mean of their stakes.
    """
    log_e, path, owned = 0.0, [], {stake / 10: 0.2 for stake in (1, 3, 5, 7, 9)}
    for difference in differences:
        grown = {stake: share * (1 + difference * stake) for stake, share in owned.items()}
        gain = sum(grown.values())
        owned = {stake: share / gain for stake, share in grown.items()}
        log_e += math.log(gain)
        path.append(log_e)
    return path


def anytime(differences: Sequence[float], alpha: float) -> Ends | None:
    """Return the interval of those mean differences that the bets have not refuted; None if the interval is empty.

    A mean is refuted if a bet against it has won enough after any pair. The bets are those of `score_bets`. For each
    tested mean, the differences are rescaled first, such that the tested mean becomes 0 and -1 remains -1.
    """

    def refuted(values: Sequence[float]) -> float:
        def stands(mean: float) -> float:
            return -max(score_bets([(1 + d) / (1 + mean) - 1 for d in values]), default=0.0)

        least = -1 + 1e-12
        return solve(stands, math.log(alpha / 2), least, 1.0) if stands(least) < math.log(alpha / 2) else -1.0

    low, high = refuted(differences), -refuted([-d for d in differences])
    return [low, high] if low <= high else None


def sign_flips(differences: Sequence[float], widest: float = 1.0) -> float:
    """Return the two-sided probability of a sum of differences as large as the observed one.

    The probability holds if each difference is equally likely to have either sign. It is computed in integers, from the
    coefficients of the product of all (1 + x^d); all coefficients are packed into one long number.
    """
    units: list[int] = []
    for parts in (25_200, 2_520, 420, 60, 12):
        units = [unit for unit in (round(d / widest * parts) for d in differences) if unit]
        common = math.gcd(*units) or 1
        units = [unit // common for unit in units]
        if sum(map(abs, units)) * len(units) <= 10_000_000:
            break
    observed, total, bits = abs(sum(units)), sum(map(abs, units)), len(units) + 2
    if not observed:
        return 1.0
    packed = 1
    for unit in units:
        packed += packed << (bits * abs(unit))
    below = packed & ((1 << bits * ((total - observed) // 2 + 1)) - 1)
    return 2 * (below % ((1 << bits) - 1)) / 2 ** len(units)


def separated(names: Sequence[str], p: dict[frozenset[str], float], alpha: float) -> set[frozenset[str]]:
    """Return the pairs with a corrected probability of at most `alpha`."""
    return {frozenset(pair) for pair in combinations(names, 2) if p[frozenset(pair)] <= alpha}
