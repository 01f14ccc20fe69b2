"""Parameters of the filter: assumptions about hands, cameras and paint, each with unit and provenance.

*Develop rigs* are those of `rhot evaluate motion --half develop`, the *rendered pictures* those of `rhot evaluate
pictures`, *simulated hands* those of `rhot evaluate tracking`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """How the markers of one hand move; see `motion`.

    The shares were chosen by the errors on 36 recordings of daily actions (FPHA, three people) through 20 random rigs
    at 15, 30 and 60 fps, and are flat there: half or twice of each changes the median by less than 5 %.

    Attributes:
        common: share of the acceleration that all markers of a hand have in common, root of a power.
        turning: the same of acceleration by turning, per metre from the middle of the markers.
        own: the same of each marker's own.
        longest_arm_m: no marker turns about the middle of its hand on a longer arm, metres; half a hand.
        scales: what the shares are multiplied by: roots of the power spectral density of an acceleration, m/s^1.5, from
            a hand at rest to 40 m/s² within one frame; the filter weighs them by what it sees.
        shares: how often each scale occurs, before anything is seen.
        joining_s: time constant within which a marker's velocity becomes that of its hand, seconds; a finger bends and
            comes to rest in 0.2 to 0.4 s.
        persists_s: time constant of the hand's common acceleration, seconds: a corner at 2 Hz, as reaches take 0.4 to
            0.8 s (Flash and Hogan, J. Neurosci. 5(7), 1985); a swing at 1.2 Hz errs alike between 0.06 and 0.12.
        abrupt: of the common acceleration this share is white as well: a hand that meets a table stops at once, and
            hidden markers with it.
        first_m_s2, first_rad_s2: standard deviations of that acceleration when a hand is first seen, each component.
        switch_s: time constant within which a scale gives way to those shares, seconds. Longer is calmer at rest and
            less honest in motion: on eight develop rigs at 60 fps 0.03 and 0.1 hold 93 and 91 % of errors
            within two sigma, with a 95th percentile of 7.6 and 8.2 mm.
    """

    common: float = 1.0
    turning: float = 8.0
    own: float = 1.0
    longest_arm_m: float = 0.1
    scales: tuple[float, ...] = (0.01, 0.1, 0.5, 1.6, 5.0, 16.0)
    shares: tuple[float, ...] = (0.1, 0.2, 0.3, 0.25, 0.13, 0.02)
    switch_s: float = 0.03
    joining_s: float = 0.2
    persists_s: float = 0.08
    abrupt: float = 0.5
    first_m_s2: float = 5.0
    first_rad_s2: float = 40.0


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """How far pixels are trusted; see `noise`.

    Attributes:
        first_px: standard deviation of a coordinate before anything is learnt, pixels; centroids of painted tips in
            photo-real pictures err by 0.2 to 0.3 px.
        least_px, most_px: bounds of what is learnt, pixels.
        first_weight: observations that the first value counts for.
        memory: observations after which what was learnt has faded to 37 %; about 20 s of a hand before one camera.
        calibration_px: systematic error between cameras where `cameras.json` states none, pixels.
        uncalibrated_px: the noise of a rig without `cameras.json`, pixels, beside what its time stamps err by.
        uncalibrated_least_px: bound of what is learnt of such a rig, pixels: it tells whole pixels, or knows its lenses
            no better.
        uncalibrated_s: standard deviation of the time stamps of such a rig, seconds: it stamps arrivals.
    """

    first_px: float = 0.3
    least_px: float = 0.05
    most_px: float = 2.0
    first_weight: float = 50.0
    memory: float = 5000.0
    calibration_px: float = 0.2
    uncalibrated_px: float = 1.0
    uncalibrated_least_px: float = 0.3
    uncalibrated_s: float = 0.006


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """When a marker is believed; see `tracks`.

    Attributes:
        gate: squared Mahalanobis distance of an observation (2 degrees of freedom) beyond which it is refused; chance
            passes it once in 270,000.
        far: the same beyond which a marker of a calibrated rig is less certain than was stated, 1 % by chance: the
            scale of accelerations is that of the whole hand, and one finger may curl while the others rest. Of the
            rendered pictures as they are, mirrored, smaller, larger and at half the rate the mean 95th percentile is
            5.3 mm at 9, 5.4 at 14 and 5.6 without; smoothed 4.8, 4.8 and 5.0, and 5.6 at 6. Where one blob in twenty is
            wrong, as in a rig that was never calibrated, paths run away. When smoothing, so does a marker less
            certain than `loose_m`; with that limit smoothed pictures, three other rendered worlds among them,
            have a 95th percentile of 4.4 instead of 4.6 mm.
        back: the same of a view of a marker that the camera had lost; 5 % by chance.
        initialisation_gate: the same of the two views of a marker that is not known (1 degree of freedom): 4 sigma.
        pair_s, pair_periods: two views further apart in time, or in frame periods, begin no marker; cameras out of step
            are half a period apart, and a frame may be lost.
        speed_sigma: of a marker that was just found, about its hand's or 0, m/s: 95 % of daily actions are below 1.
        confirmations: views that must agree with the two that began a marker, before it is published.
        uncalibrated_confirmations: the same before cameras that are not calibrated, where two views seldom contradict.
        relocations: pairs of views in a row that agree on another place before a marker is moved there.
        occupied_m: no marker begins nearer to another one, metres.
        fresh_periods, fresh_s: a camera counts among a marker's views as long as its last one is no older than the
            longer of these.
        ray_sigma_m: how far a marker that only one camera has seen may be from its hand in depth, metres.
        moving_px_s: a marker that moves faster through the picture is never twice at the same place to the last digit.
        ray_views: views in a row of one camera that put a marker on its ray.
        fewest: markers of a hand that tell how far away it is; in a grasp the patch is often the only one.
        ray_reach_m: no marker begins on its ray further from the middle of its hand's, metres; a hand's length.
        loose_m: a marker whose place is less certain (standard deviation) is found again by two views, metres: beyond
            it a depth is no longer linear in the pixels.
        extent_m: standard deviation in depth of a marker about the middle of its hand's, metres: fingertips that one
            camera sees are 0.026 behind it, plus or minus 0.027 (15 develop rigs).
        lost_periods: one that nothing has shown for so many frame periods is not moved by a single view.
        measured_m: a point is called measured up to this standard deviation (root of the covariance's trace, hidden
            paint included, the calibration's error not) beyond what any two views leave open, metres: the breadth of a
            little finger's tip; what is known no better may be the finger beside it. No other sign tells more of a
            point's error: not how much paint comes, goes or differs between cameras, nor all of them together (15
            develop rigs at 15, 30 and 60 fps). At 0.0125 coverage of 30 develop rigs is 97.2 instead of 96.7 % at 60
            fps and 92.4 instead of 91.3 % at 30, the 95th percentile of errors 7.83 instead of 7.74 mm and 9.70 instead
            of 9.34 mm; of the others 9.25 instead of 8.65 mm at 60 fps.
        uncalibrated_measured_m: the same before cameras that are not calibrated: four pixels, of 2 cm of depth there.
        lost_m: a marker is not published beyond this one, and forgotten when nothing shows it any more, metres: that it
            is somewhere on its hand tells as much. What slow cameras out of step begin with is known less well at 15
            frames per second, and was forgotten at once.
        replay_s: frames that come later than this after a newer one are used for nothing, seconds.
    """

    gate: float = 25.0
    far: float = 9.0
    back: float = 6.0
    initialisation_gate: float = 16.0
    pair_s: float = 0.15
    pair_periods: float = 1.6
    speed_sigma: float = 0.5
    confirmations: int = 0
    uncalibrated_confirmations: int = 6
    relocations: int = 3
    occupied_m: float = 0.010
    fresh_periods: float = 1.5
    fresh_s: float = 0.04
    ray_sigma_m: float = 0.08
    moving_px_s: float = 60.0
    ray_views: int = 3
    fewest: int = 1
    ray_reach_m: float = 0.2
    loose_m: float = 0.03
    extent_m: float = 0.037
    lost_periods: float = 2.5
    measured_m: float = 0.011
    uncalibrated_measured_m: float = 0.08
    lost_m: float = 0.12
    replay_s: float = 0.06


@dataclass(frozen=True, slots=True)
class PaintSettings:
    """What is seen of a painted marker; see `paint`.

    Attributes:
        compare_s: areas further apart in time are not compared, seconds.
        settle_s: time constant of the widths that are compared, while they differ by less than `uneven` of late,
            seconds. A larger change is followed at once: a lag of 0.03 made 20 mm of depth within 0.1 s of a thumb that
            one camera loses first. On 15 develop rigs, three simulated hands and the rendered pictures 0.03
            and 0.1 are alike, longer is calmer at rest.
        uneven: views of a whole marker differ by this share of its area, by the cameras' places.
        rim_px: and by this much of its rim, pixels: a quarter of a pixel of its radius.
        doubtful: where two views of a marker differ by this many times as much as those of a whole one, half of that is
            taken for hidden: less of smaller differences, nearly all of larger ones. 1 and 1.5 beside a dead zone as
            wide as that: 79 and 86 swapped points of 102 on 15 develop rigs, 29 and 22 false ones of 31 in six
            simulated scenes; medians are alike at 1.5, and 0.1 mm worse at 1.
        cut: standard deviation of how far the middle of a marker lies beside what the picture's border leaves of it, as
            a share of that: markers are no squares that stand upright.
        shift: of the middle, as a share of the width that is hidden: a strip moves it by half of itself.
        doubt: standard deviation of that, in the same unit.
        lasts_s: how long that error stays the same, seconds: a finger passes behind another, 15 mm at 0.15 m/s; without
            it a strip of paint that is left becomes depth and speed, however little one believes each frame. Between
            0.1 and 0.3 alike on eight develop rigs; smoothed pictures are worse by 1.5 mm at 0.3.
        side: (π/4) ρ of `paint`.
        shaft: λ of `paint`: tips are painted over 15 to 20 mm and 6 to 7 mm thick.
        first_bend: c of a finger at ease, bent away from the camera by a quarter of a right angle or a little more.
        most_bend: c beyond which a small area tells that paint is hidden rather than how a finger bends: 45 degrees;
            between 0.7 and 0.8 alike within 0.1 mm on rendered pictures and two simulated hands.
        appears_s: time constant of the width that what is visible is compared with, seconds: two frames at 60 fps.
        appearing: standard deviation of where the middle of a marker is that comes out from behind something, as a
            share of its width: half of what one can see is hidden at the median; 0.1 to 0.25 alike.
        seen_first: how far the largest area of a marker is taken from its first one rather than from how long paint
            should be: between 0 and 0.5 alike on rendered and simulated hands, 1 is worse by 0.4 mm on the latter.
        curled, straight: shares of a finger's reach from beside the patch, between which what is told of its end's
            direction grows from nothing to all. On 15 develop rigs (60 fps, the side that is seen beside
            the truth) the best factor of that shift is −0.2, 0.3, 0.6, 1.1 and 0.9 at 0.51, 0.63, 0.78, 0.86 and 0.97
            of the reach; a twentieth less is alike. It errs on the side of nothing: little paint is oftener hidden.
        most_turned: share of its area that a patch shows at least when it is turned away: that of 60 degrees, beyond
            which the back of a hand is seen edge-on. What is missing beyond that is hidden.
        found: share of a tip's area that is found as its colour; the rim is mixed with what is behind.
        hidden: standard deviation of a tip's middle for paint that no camera shows, each axis, as a share of the width
            that is missing beyond `most_bend`. On the ruler's 15 even rigs at 60 fps, of points whose fullest view
            shows 0.15 to 0.2, 0.2 to 0.3, 0.3 to 0.4 and 0.4 to 0.6 of the largest area, 66, 30, 25 and 14 % of
            normalised errors were beyond 95 % of chi-square without it; 5, 9, 11 and 10 % are with it.
        slack_px, slack: what a gate allows for beyond the filter's covariance, pixels and a share of the width: a tip
            that half hides within one frame.
    """

    compare_s: float = 0.1
    settle_s: float = 0.05
    uneven: float = 0.05
    rim_px: float = 0.5
    doubtful: float = 1.5
    cut: float = 0.5
    shift: float = 0.5
    doubt: float = 0.25
    lasts_s: float = 0.1
    appears_s: float = 0.03
    appearing: float = 0.15
    side: float = 0.66
    shaft: float = 1.8
    first_bend: float = -0.45
    most_bend: float = -0.7
    seen_first: float = 0.25
    curled: float = 0.65
    straight: float = 0.95
    most_turned: float = 0.5
    found: float = 0.9
    hidden: float = 0.5
    slack_px: float = 0.5
    slack: float = 0.05


@dataclass(frozen=True, slots=True)
class SystematicSettings:
    """What is added to covariances for errors that no frame tells of; see `systematic`.

    Attributes:
        doubt: what the stated error of a calibration is multiplied by: it is stated for the middle of the picture, and
            three times as much near the rim (simulated calibrations of 30 rigs, `rhot evaluate motion`).
        across: share of the calibration's squared error along each axis across the view; the rest is depth. A baseline
            of an eighth of the distance makes depth eight times worse than sideways; more is left for the lens.
        shape: what the middle of a fingertip may be off for its paint and the side that is seen, each axis, as a share
            of its radius: 2 mm of 6.5.
    """

    doubt: float = 1.6
    across: float = 0.15
    shape: float = 0.3


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """All of them."""

    motion: MotionSettings = MotionSettings()
    noise: NoiseSettings = NoiseSettings()
    track: TrackSettings = TrackSettings()
    paint: PaintSettings = PaintSettings()
    systematic: SystematicSettings = SystematicSettings()


DEFAULT: Final = FilterSettings()
