"""Settings of noise and intervals: each threshold and the decision it controls (own choices, by the campaigns of docs/accuracy)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NoiseSettings:
    """Limits and ranges of the noise model.

    A *gain* is the gain in twice the logarithm of the restricted likelihood.
    """

    # Levels of white noise and random walk
    lowest_ratio: float = -10.0
    """Least ``log10(q h/r)`` searched: pure angle noise."""
    highest_ratio: float = 4.0
    """Largest ``log10(q h/r)`` searched: pure random walk."""
    first_rows: int = 1 << 17
    """Increments used by the first, coarse passes over a long record."""
    refinements: int = 4
    """Passes over the residuals; two less if the ratio is known to a decade."""
    ratio_spacing: float = 0.1
    """Spacing of ``log10(q h/r)`` at which the grid of a long record is no longer refined; a parabola finds the optimum
    between its points."""
    ratio_passes: int = 12
    """Most passes over the residuals of a long record; one to three are usual."""
    ratio_known: float = 1.0
    """Range of ``log10(q h/r)`` to both sides of an earlier estimate."""
    ratio_known_long: float = 0.14
    """The same in a long record: the fit before gives it closely."""
    settled_share: float = 1e-4
    """Share of the white noise in the variance of a long span, in records that are not long."""
    walk_in_weights: float = 1.5
    """Gain above which a random walk enters the weights. A fainter one enters only the covariance."""
    negligible: float = 1e-3
    """Gain below which a level does not affect the weights and is left as it is."""
    restricted_rows: int = 200_000
    """Most increments for the restricted likelihood. In a longer record the few parameters absorb no noticeable part
    of the slow noise."""
    information_ratios: tuple[float, ...] = (-9.0, -7.5, -6.0, -4.5, -3.0, -1.5, 0.0, 1.5, 3.0)
    """Values of ``log10(q h/r)`` at which the information term of the restricted likelihood is computed."""

    # Random walk that is not significant
    faint_least: float = 0.4
    """Least variance of the slowest value of the longest stretch, relative to white noise alone. Slow values that
    scatter far less than white noise predicts do so by chance."""
    faint_most: float = 30.0
    """Largest such variance searched."""
    faint_nodes: int = 6
    """Walks in this range at which the information of the coefficients is computed."""
    faint_passes: int = 2
    """Passes over the residuals."""
    faint_unclear: float = 0.02
    """Share of a walk in the variance of the slowest value up to which white-noise weights are used."""
    faint_probe: float = 0.01
    """Finite-difference step of this share for d(covariance)/d(walk)."""
    faint_twist: float = 0.1
    """Finite-difference step of the logarithm of this variance for derivatives of the likelihood."""
    faint_enough: float = 3.0
    """Fewest slow values that the coefficients must leave. With fewer, no walk is assumed."""

    # Bias drift and scatter of the segments
    slow_suspected: float = 0.3
    """Gain with the other levels fixed above which all levels are estimated together."""
    slow_in_covariance: float = 2.0
    """Gain above which a slow noise enters the covariance."""
    slow_in_weights: float = 9.0
    """Gain above which it also enters the weights. Weights for a drift that does not exist may cost six times the
    variance."""
    slow_below: float = 0.7
    """Search range of the random walk if there is slow noise: decades below the walk estimated without slow noise."""
    slow_above: float = 0.35
    """Decades above that walk."""
    slow_levels: int = 41
    """Trial levels over eight decades."""
    slow_undetermined: float = 1e-9
    """Smallest independent part of a column for an estimate."""
    slow_enough: int = 3
    """Fewest independent values of a slow noise that the coefficients must leave."""
    fewest_segments: int = 4
    """Fewest segments for the scatter search."""
    most_segments: int = 128
    """Most segments for the scatter search."""
    look_bins: int = 16
    """Bins of a stretch in the quick test of a long record."""
    look_most_bins: int = 2048
    """Most bins of all stretches together in this test."""

    # Stated scatter of the segments
    stated_lost: float = 0.2
    """Largest variance of a mean rate by a stated scatter, relative to the noise, for which the scatter is ignored in
    levels and weights."""
    stated_below: float = 4.0
    """Search range of the random walk if a scatter is stated: decades below the walk estimated without the scatter."""
    fixed_rate: float = 1e-12
    """Variance of the rate of a segment without scatter, relative to the largest scatter."""

    # Degrees of freedom
    degrees_large: int = 200_000
    """Increments above which only the least degrees of freedom are given, because the levels are known well."""
    degrees_step: float = 0.05
    """Relative finite-difference step for d(variance)/d(noise level)."""
    degrees_seen: float = 0.05
    """Ratio of the random walk to its standard uncertainty below which it does not affect the weights."""
    degrees_probe: float = 0.02
    """Finite-difference step of the walk for the derivative of the information [standard deviations]."""

    # Coarse counts
    counting_white: float = 0.15
    """White noise [squared counts] above which it dithers the counting and plain whitening is right (one twelfth of it
    is the counting itself)."""
    counting_walk: float = 0.1
    """Random walk from sample to sample [squared counts] above which it dithers the counting."""
    counting_passes: int = 9
    """Most alternations between path, noise levels and estimate."""
    counting_trusted: int = 3
    """Passes before the estimated random walk may dither the counting. In earlier passes errors of the path look like a
    random walk. If their dither were used, the iteration would end without a random walk."""
    counting_levels: int = 6
    """Levels of white noise tried, over three decades."""
    counting_in_covariance: float = 0.5
    """Gain above which white noise besides the counting is accepted."""
    counting_settled: float = 0.03
    """Relative change of the variance of the random walk below which the alternation ends."""
    counting_walks: int = 13
    """Trial random walks in each of three rounds, in ever narrower ranges."""
    counting_unlikely: float = 18.0
    """Loss in twice the log-probability above which a random walk is dropped."""
    counting_long: int = 1 << 16
    """Rows above which the saw-tooth along the path is tested first. If it is white, plain whitening stays."""
    counting_same: float = 0.05
    """Largest motion of the path, in counts over the number of harmonics, before it is followed again."""
    counting_spreads: tuple[float, ...] = (0.5, 0.2)
    """Uncertainty of the path over a stretch [counts] in the first passes, before there is an estimate."""

    # Contrasts of counted stretches
    stretch_least: int = 8
    """Fewest samples of a used stretch."""
    stretch_lost: float = 0.01
    """Largest share of all samples in unused short stretches."""
    modes: int = 24
    """Fewest cosines per stretch; four more per turn of the output and order of the model."""
    most_modes: int = 160
    """Most cosines per stretch."""
    harmonics: int = 8
    """Harmonics of the saw-tooth that white noise damps one by one."""
    harmonics_short: int = 24
    """Harmonics followed in short stretches; the rest counts as white."""
    short_stretch: int = 10_000
    """Most samples of a short stretch."""
    slow_counts: float = 4.0
    """Most counts in a stretch for which the most harmonics are followed."""
    harmonics_slow: int = 96
    """Harmonics followed there."""
    most_damped: float = 0.5
    """Largest correction for damping by errors of the estimate, as a share of the damping by the random walk."""
    white_groups: int = 4
    """Test of the saw-tooth against white noise: groups of contrasts, slow to fast."""
    white_even: float = 0.6
    """Allowed difference of their mean power ratio from one."""
    white_rare: float = 7.0
    """Allowed ratio of a single contrast beyond the logarithm of their number (the ratio is exponentially distributed)."""
    white_contrasts: int = 160
    """Contrasts in all stretches together for this test, if the stretches have as many."""

    # Coloured noise
    colour_bins: int = 96
    """Parts of all segments together. Each part has its own value of the rate."""
    colour_part: float = 15.0
    """Length of a part [s] above which there are more of them."""
    colour_bins_long: int = 192
    """Most parts of all segments together in such a record. In a record of 40 positions and 96 parts flicker noise was
    mistaken for a scatter, in a record with positions of 180 s for a drift."""
    colour_most: int = 32
    """Most such parts of a segment."""
    colour_least: int = 8
    """Fewest increments in a part, on average."""
    colour_means: int = 2
    """Means of the residual angle per part in the quick test of a long record."""
    colour_suspected: float = 1.5
    """Gain of one component, added to white noise and walk, above which all components are tried."""
    colour_in_covariance: float = 4.0
    """Gain of the likeliest component above which coloured noise enters the covariance."""
    colour_ahead: float = 2.0
    """Gain by which coloured noise must exceed a drift or a scatter in an angle log. Below it, drift or scatter is
    included, because its weights lose less."""
    colour_prior: float = 1.0 / 3.0
    """Prior weight of drift, scatter and Markov noise (all times together), relative to flicker noise and to none.
    Flicker noise lies between the others, and most instruments have it."""
    colour_spacing: float = 3.0
    """Ratio of neighbouring correlation times that are tried."""
    colour_longest: float = 0.4
    """Longest correlation time tried, as a share of the record."""
    per_decade: int = 2
    """Markov processes per decade of time whose sum is the flicker noise."""

    # Restricted likelihood
    limit_step: float = 0.1
    """Step of the logarithm of the levels that are tried for an upper limit [decades]."""
    limit_shares: tuple[float, ...] = (0.0, 0.5, 0.9)
    """Shares of the random walk of the weights that a component may replace, for the upper limit of the component."""
    iterations: int = 12
    """Most steps of the search for the levels."""
    halvings: int = 12
    """Most halvings of a step that lowers the likelihood."""
    converged: float = 1e-3
    """Change of twice the log-likelihood below which the search ends."""
    separable: float = 1e-9
    """Smallest eigenvalue of the scaled information for which two levels can be separated."""


NOISE = NoiseSettings()
