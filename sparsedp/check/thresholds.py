"""The thresholds of the audit of a gradient, each with its derivation."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["THRESHOLDS", "AuditThresholds"]


@dataclass(frozen=True)
class AuditThresholds:
    """Thresholds of `check.gradient`.

    Shares are relative to the derivative along a direction unless another quantity is named. With central differences
    of a loss of size F, rounding eps and third derivative of order F, the best step is about eps^(1/3) and the error
    bar there about eps^(2/3) = 4e-11 of the derivative. Shares are multiples of that, or of what a solve to the
    default tolerance of 1e-10 leaves.

    Attributes
    ----------
    bars_disagree : float
        A gap of more than this many error bars is wrong. A bar is the largest of three distances, so the chance of ten
        bars by noise alone is negligible in a hundred lines.
    bars_agree : float
        A gap of at most this many error bars is compatible with 0. Between the two nothing is decided.
    resolved_share : float
        An error bar above this share proves nothing: three digits are the least for a statement about a derivative.
    agreement_share : float
        A gap below this share is agreement, whatever the bar: about 270 eps^(2/3).
    noisy_agreement_share : float
        The same behind a solve, or in noise: the remainder of a solve to 1e-10 is amplified by the condition of the
        system and by 1 / step, and may be smooth in x.
    agreement_per_noise : float
        Between these two limits a gap may have this multiple of the measured noise of the loss: eps^(-1/4), the
        factor by which the best step of a second-order difference enlarges noise.
    solve_remainder_share : float
        Behind a solve, a gap below this share of the loss may be a remainder of the solve: ten times its tolerance.
    solve_remainder_tolerances : float
        The same in units of the tolerance of the solves, where that is looser.
    step_remainder_tolerances : float
        A gap below this many tolerances of time steps may be a remainder of their error control.
    loose_tolerance : float
        A tolerance of solves above this may explain any gap for which no call is at fault.
    mode_tolerances : float
        Forward and reverse mode may differ by this many tolerances of the solves: each mode ends at another residual.
    mode_gap : float
        Share by which forward and reverse mode may differ by rounding: about 5e5 eps, for sums of 1e5 terms and more.
    noisy_mode_gap : float
        The same behind a solve or in noise.
    complex_step_gap : float
        Share by which a complex step may differ by rounding.
    smallest_loss_change : float
        Losses that change by less than this underflow: their differences are not normal numbers.
    vanishing_share : float
        A derivative and its bar below this share of the curvature are 0.
    negligible_share : float
        An undecided direction whose derivative is below this share of the largest one does not matter.
    small_share : float
        The same for a direction whose derivative is resolved to one digit.
    rounding_noise : float
        Noise above this many roundings of the loss has another cause: a solve, chaos, a staircase.
    smooth_noise : float
        A smooth function varies by at most this many roundings between neighbouring steps.
    noise_levels : int
        Number of finest levels that the noise is read from.
    fewest_levels : int
        Usable levels without which nothing is decided: two Richardson extrapolations need four.
    fewest_orders : int
        Usable levels without which a Taylor order is not decided.
    most_orders : int
        Usable levels that an order is read from, the finest ones.
    first_order_margin : float
        The order of f(x + t d) - f is 1 to within this.
    second_order : float
        Least order of the remainder with the gradient.
    third_order : float
        Least order of the remainder with gradient and Hessian product.
    wrong_hessian_order : float
        Up to here the order is 2, which a wrong Hessian gives; above, the loss has no third derivatives.
    odd_share : float
        Share of a third remainder that may change its sign with the step; more, and the Hessian jumps at x.
    clear_of_noise : float
        A usable remainder is this many times the noise, which then moves an order by at most
        log(1.01 / 0.99) / log(pair_ratio) = 0.015.
    linear_share : float
        A level serves for order 1 where t |g . d| is this many times the even part, which then moves the order by at
        most log(sqrt(1 + 1 / 25)) / log(pair_ratio) = 0.015.
    nearby_steps : float
        Orders are read at steps up to this multiple of the step of the plateau; coarser ones are no limit t -> 0.
    pair_ratio : float
        Least ratio of the two steps of a pair that gives an order.
    extension_bar : float
        A sweep is extended where its error bar is above this share.
    ripple_run : int
        Neighbouring fine levels that agree with each other on another derivative show a ripple.
    ripple_agreement : float
        Share to which they agree; also the share of a gap above which the rounding of the loss hides a ripple.
    ripple_reaches : tuple of float
        The gradient is evaluated within these multiples of the step over which a gap changes the loss by its noise.
    ripple_smoothness : float
        Within this share of such a step a ripple is smooth, and a kink is not.
    ripple_range : float
        Within this share of the step of the plateau a smooth gradient does not bend.
    """

    bars_disagree: float = 10.0
    bars_agree: float = 3.0
    resolved_share: float = 1e-3
    agreement_share: float = 1e-8
    noisy_agreement_share: float = 1e-6
    agreement_per_noise: float = 1e4
    solve_remainder_share: float = 1e-9
    solve_remainder_tolerances: float = 10.0
    step_remainder_tolerances: float = 10.0
    loose_tolerance: float = 1e-8
    mode_tolerances: float = 1e3
    mode_gap: float = 1e-10
    noisy_mode_gap: float = 1e-6
    complex_step_gap: float = 1e-10
    smallest_loss_change: float = 1e-303
    vanishing_share: float = 1e-6
    negligible_share: float = 1e-6
    small_share: float = 1e-3
    rounding_noise: float = 1e3
    smooth_noise: float = 30.0
    noise_levels: int = 5
    fewest_levels: int = 4
    fewest_orders: int = 3
    most_orders: int = 5
    first_order_margin: float = 0.05
    second_order: float = 1.95
    third_order: float = 2.9
    wrong_hessian_order: float = 2.1
    odd_share: float = 0.1
    clear_of_noise: float = 100.0
    linear_share: float = 5.0
    nearby_steps: float = 70.0
    pair_ratio: float = 4.0
    extension_bar: float = 1e-5
    ripple_run: int = 3
    ripple_agreement: float = 0.1
    ripple_reaches: tuple[float, ...] = (1.0, 20.0)
    ripple_smoothness: float = 1e-4
    ripple_range: float = 0.01


THRESHOLDS = AuditThresholds()
