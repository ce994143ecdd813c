"""The thresholds of `check.gradient` and of the checks of derivatives of other programs, each with its derivation."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["REVIEW", "THRESHOLDS", "AuditThresholds", "ReviewThresholds"]


@dataclass(frozen=True)
class AuditThresholds:
    """Thresholds of `check.gradient`.

    A share is a ratio to the derivative along a direction, unless another quantity is named. For central differences of
    a loss of size F with relative rounding error eps and a third derivative of order F, the best step is about
    eps^(1/3), and the relative error bar there is about eps^(2/3) = 4e-11. The shares are multiples of this error bar,
    or of the error of a solve with the default tolerance of 1e-10.

    Attributes
    ----------
    bars_disagree : float
        A gap of more than this many error bars is significant. A gap of ten error bars by noise alone is very unlikely,
        even among a hundred directions, because an error bar is the largest of several distances.
    bars_agree : float
        A gap of at most this many error bars is compatible with 0. Gaps between `bars_agree` and `bars_disagree` are
        undecided.
    resolved_share : float
        With an error bar above this share there is no decision: a verdict needs at least three digits.
    agreement_share : float
        A gap below this share counts as agreement for every error bar: about 270 eps^(2/3).
    noisy_agreement_share : float
        The same share for a loss with solves or with noise. The error of a solve with tolerance 1e-10 is amplified by
        the condition number of the system and by 1 / step, and may be smooth in x.
    agreement_per_noise : float
        Between these two shares, the allowed gap is this multiple of the measured noise of the loss. It is eps^(-1/4),
        the factor by which the best step of a second-order difference amplifies noise.
    solve_remainder_share : float
        For a loss with solves, a gap below this share of the loss may be the error of a solve: ten times its tolerance.
    solve_remainder_tolerances : float
        The same limit as a multiple of the tolerance of the solves; the larger limit applies.
    step_remainder_tolerances : float
        A gap below this multiple of the tolerance of time steps may be due to their error control.
    loose_tolerance : float
        If the tolerance of the solves is above this value, and no call is at fault, the gap may be due to the solves.
    mode_tolerances : float
        Forward and reverse mode may differ by this multiple of the tolerance of the solves, because the solves of the
        two modes end with different residuals.
    mode_gap : float
        Share by which forward and reverse mode may differ due to rounding: about 5e5 eps, enough for sums of 1e5 terms.
    noisy_mode_gap : float
        The same for a loss with solves or with noise.
    complex_step_gap : float
        Share by which a complex step may differ due to rounding.
    smallest_loss_change : float
        If the loss changes by less than this value, its differences are subnormal numbers and lose digits.
    vanishing_share : float
        A derivative counts as 0 if it and its error bar are below this share of the curvature.
    negligible_share : float
        An undecided direction is ignored if its derivative is below this share of the largest derivative.
    small_share : float
        An undecided direction whose derivative is known to one digit is ignored if its error bar is below this share of
        the largest derivative.
    rounding_noise : float
        Noise above this number of roundings of the loss is not due to rounding, but to solves, chaos or steps.
    smooth_noise : float
        A smooth function varies by at most this many roundings between neighbouring steps.
    noise_levels : int
        Number of finest levels from which the noise is measured.
    fewest_levels : int
        Smallest number of usable levels for a decision. The error bars of Richardson extrapolation need four.
    fewest_orders : int
        Smallest number of usable levels for a Taylor order.
    most_orders : int
        An order is measured from at most this number of usable levels, the finest ones.
    first_order_margin : float
        Largest allowed deviation of the order of f(x + t d) - f(x) from 1.
    second_order : float
        Smallest allowed order of the second Taylor remainder (with the gradient).
    third_order : float
        Smallest allowed order of the third Taylor remainder (with gradient and Hessian product).
    wrong_hessian_order : float
        An order of the third remainder up to this value counts as 2, which shows a wrong Hessian. For orders between
        this value and `third_order` the loss is not three times differentiable.
    odd_share : float
        Allowed share of the odd part in a third remainder of order 2. If it is larger, the Hessian jumps at x.
    clear_of_noise : float
        A remainder is usable if it is at least this multiple of the noise. Noise then changes an order by at most
        log(1.01 / 0.99) / log(pair_ratio) = 0.015.
    linear_share : float
        A level is used for order 1 if t |g . d| is at least this multiple of the even part. The even part then changes
        the order by at most log(sqrt(1 + 1 / 25)) / log(pair_ratio) = 0.015.
    nearby_steps : float
        Orders are measured at steps up to this multiple of the step of the plateau. Coarser steps do not show the
        limit t -> 0.
    pair_ratio : float
        Smallest ratio of two steps from which an order is computed.
    extension_bar : float
        More steps are added to a sweep if its error bar is above this share.
    ripple_run : int
        Number of neighbouring fine levels that must show the same other derivative to detect a ripple.
    ripple_agreement : float
        Relative difference that is allowed between these levels. Rounding must also be below this share of their gap.
    ripple_reaches : tuple of float
        Multiples of a step at which the gradient is evaluated to detect a ripple below the noise. The step is that over
        which the gap changes the loss by as much as its noise.
    ripple_smoothness : float
        The gradient is also evaluated at this share of such a step, to distinguish a ripple, which is smooth, from a
        kink.
    ripple_range : float
        A ripple is only searched within this share of the step of the plateau, where a smooth gradient is nearly
        constant.
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


@dataclass(frozen=True)
class ReviewThresholds:
    """Thresholds by which `check.vjp` and the other checks of derivatives tell errors from properties of a program.

    A gap of linearity is the relative gap between the derivative of a linear combination of vectors and the combination
    of their derivatives. It is about eps for a right derivative, 1e-8 to 1e-7 if numbers are rounded to single
    precision, and about the tolerance of an inexact solve. A nudge is a tiny relative change of a vector: a smooth
    function of it has a second difference far below its first difference, and rounding errors have one of equal size.

    Attributes
    ----------
    rounding_gap : float
        A gap of linearity up to this value is due to rounding: about 500 eps.
    rounding_gap_eps : float
        The same limit in units of the eps of x and f(x); matters in single precision.
    linear_share : float
        A gap of linearity up to this value is allowed: above single precision, below solves that are called loose.
    nonlinear_gap : float
        A larger gap of linearity is an error. A smaller one may come from an inexact solve; tolerances above 1 % are
        unusual.
    inexact_shares : float
        A gap along a direction up to this multiple of the gap of linearity may be due to the same inexact solve, whose
        error is amplified by the condition number and by terms that cancel.
    single_precision_gap : float
        A smaller gap of linearity is not due to single precision: a hundredth of its eps.
    resolved_share : float
        The differences at x are exact if their error bars are below this share of the gap of linearity.
    coarse_step : float
        Steps from this one on are coarse: an inexact solve changes a difference by its tolerance divided by the step.
    exact_share : float
        The solves of f are exact if differences with coarse steps vary by at most this share of the gap.
    nudge : float
        Relative change of a vector far below the rounding of single precision, and far above eps.
    rough_share : float
        A second difference of a derivative above this share of its first difference is due to rounding.
    larger_nudge : float
        Relative change of x above the rounding of single precision.
    single_precision_share : float
        A second difference above this share, for the larger nudge, shows the rounding of single precision, which
        changes the first difference by 6e-8 / 1e-6. That of a smooth derivative is about 1e-6.
    least_change : float
        A smaller change of a VJP, relative to that of x, is due to rounding in double precision: eps / larger_nudge is
        2e-10, amplified by terms that cancel.
    smooth_noise : float
        With more noise of f, in units of its rounding, the roughness of a derivative shows nothing about single
        precision.
    long_scale : float
        Ratio of two steps over which the change of a differentiable function decreases clearly.
    unchanged_share : float
        f varies on a finer scale than the steps if its change decreases less than by this factor over such a ratio.
    rounding_step : float
        Rounding of intermediate values may be visible in steps below this one: half of the digits, eps^(1/2) / 2.
    far_steps : float
        Steps from this multiple on are far above the best one.
    steep_share : float
        Fine steps show rounding inside f if all far steps show a derivative below this share of theirs.
    stairs : int
        Number of steps without any change of f that show a staircase.
    clear_of_rounding : float
        A change above this number of roundings of f should be visible.
    amplified_share : float
        A change of a derivative in other rounding modes indicates an ill-conditioned problem only if the differences
        of f change by at least this share of it. It is between the ratio of double to single precision, 2e-9, amplified
        by steps and sums, and the ratio of 1/20 that was measured for Vandermonde matrices and their transposes.
    same_gap_share : float
        A step shows the same gap as the best one if it differs by at most this share.
    """

    rounding_gap: float = 1e-13
    rounding_gap_eps: float = 100.0
    linear_share: float = 1e-5
    nonlinear_gap: float = 1e-2
    inexact_shares: float = 1e3
    single_precision_gap: float = 1e-9
    resolved_share: float = 0.01
    coarse_step: float = 2.0**-6
    exact_share: float = 1e-3
    nudge: float = 1e-10
    rough_share: float = 0.3
    larger_nudge: float = 1e-6
    single_precision_share: float = 2e-3
    least_change: float = 1e-4
    smooth_noise: float = 1e3
    long_scale: float = 2.0**6
    unchanged_share: float = 0.1
    rounding_step: float = 2.0**-27
    far_steps: float = 2.0**9
    steep_share: float = 0.05
    stairs: int = 2
    clear_of_rounding: float = 100.0
    amplified_share: float = 1 / 30
    same_gap_share: float = 0.1


REVIEW = ReviewThresholds()
