"""Parameters of the filter: assumptions about hands, cameras and paint, each with unit and provenance.

The values were chosen on the *develop rigs* of `rhot evaluate motion --half develop`, the *rendered pictures* of `rhot
evaluate pictures` and the *simulated hands* of `rhot evaluate tracking`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """Motion model of the markers of one hand; see `motion`.

    `common`, `turning` and `own` were chosen on 36 recordings of daily actions (FPHA, three people) seen by 20 random
    rigs at 15, 30 and 60 fps. Halving or doubling any of them changes the median error by less than 5 %.

    Attributes:
        common: relative strength of the linear acceleration that all markers of a hand share.
        turning: relative strength of the angular acceleration, per metre from the centroid of the markers.
        own: relative strength of each marker's individual acceleration.
        longest_arm_m: upper bound of the lever arm about the hand's centroid, metres; half a hand.
        scales: noise intensities that multiply the three strengths above: square roots of the acceleration's power
            spectral density, m/s^1.5, from a hand at rest to 40 m/s² within one frame. The filter weights them by the
            likelihood of the observations.
        shares: prior probability of each scale.
        joining_s: time constant with which a marker's velocity returns to that of its hand, seconds; a finger bends and
            comes to rest in 0.2 to 0.4 s.
        persists_s: correlation time of the shared acceleration, seconds: a corner frequency of 2 Hz, because reaches
            last 0.4 to 0.8 s (Flash and Hogan, J. Neurosci. 5(7), 1985). For a swing at 1.2 Hz, errors are the same
            between 0.06 and 0.12.
        abrupt: share of the shared acceleration that is white instead: a hand that hits a table stops at once, and
            so do its hidden markers.
        first_m_s2, first_rad_s2: standard deviation of each component of the shared acceleration when a hand is first
            seen.
        switch_s: time constant with which the weights of the scales return to `shares`, seconds. Longer values reduce
            jitter at rest but make covariances too small in motion: on eight develop rigs at 60 fps, 93 % of errors are
            within two sigma at 0.03 and 91 % at 0.1, with a 95th percentile of 7.6 and 8.2 mm.
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
    """Measurement noise of a camera; see `noise`.

    Attributes:
        first_px: initial standard deviation of a pixel coordinate; centroids of painted tips in photo-real pictures
            have errors of 0.2 to 0.3 px.
        least_px, most_px: bounds of the estimated standard deviation, pixels.
        first_weight: number of observations that the initial value counts as.
        memory: number of observations after which the weight of an old observation has decayed to 37 %; about 20 s of a
            hand in front of one camera.
        calibration_px: systematic error between cameras if `cameras.json` states none, pixels.
        uncalibrated_px: pixel noise of a rig without `cameras.json`, not counting errors of its time stamps.
        uncalibrated_least_px: lower bound of the estimate for such a rig, pixels: its coordinates are whole pixels, or
            its lens distortion is unknown.
        uncalibrated_s: standard deviation of the time stamps of such a rig, seconds: frames are stamped on arrival.
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
    """Track management: gates, initialisation and the states that are published; see `tracks`.

    Attributes:
        gate: squared Mahalanobis distance (2 degrees of freedom) beyond which an observation is rejected; exceeded by
            chance once in 270,000.
        inflation_gate: squared Mahalanobis distance beyond which the covariance of a marker of a calibrated rig is
            inflated; 1 % by chance. The acceleration scale belongs to the whole hand; one finger may curl alone.
            Over the rendered pictures, mirrored, scaled down, scaled up and at half the rate, the mean 95th percentile
            is 5.3 mm at 9, 5.4 at 14 and 5.6 without inflation; smoothed 4.8, 4.8 and 5.0, and 5.6 at 6. Not used for
            uncalibrated rigs: where one blob in twenty is wrong, tracks diverge. In smoothing not used either for
            markers beyond `loose_m`; this limit lowers the smoothed 95th percentile from 4.6 to 4.4 mm on these
            pictures and three more rendered worlds.
        reacquisition_gate: the same for the first observations of a marker that its camera had lost; 5 % by chance.
        initialisation_gate: squared Mahalanobis distance (1 degree of freedom) up to which two views initialise a
            marker: 4 sigma.
        pair_s, pair_periods: longest time between these two views, in seconds and in frame periods; unsynchronised
            cameras are half a period apart, and one frame may be lost.
        speed_sigma: standard deviation of a new marker's velocity about that of its hand, or about 0, m/s; in daily
            actions 95 % of speeds are below 1 m/s.
        confirmations: further views that must agree before a new marker is published.
        uncalibrated_confirmations: the same in uncalibrated rigs, where two views rarely contradict each other.
        relocations: consecutive pairs of views that must agree on a different position before a marker is moved there.
        occupied_m: no marker is initialised closer to another one than this, metres.
        fresh_periods, fresh_s: a camera counts as seeing a marker while its last observation is no older than the
            longer of these, frame periods and seconds.
        ray_sigma_m: standard deviation in depth, about its hand, of a marker initialised from one camera, metres.
        moving_px_s: above this image speed, exactly repeated coordinates are treated as stale data.
        ray_views: consecutive views of one camera that initialise a marker on its viewing ray.
        depth_markers: markers of a hand required to estimate its depth; in a grasp the patch is often the only one.
        ray_reach_m: greatest distance from the centroid of its hand at which a marker is initialised from one camera,
            metres; a hand's length.
        loose_m: a marker whose standard deviation is larger is initialised anew by two views, metres: at that size,
            depth is no longer linear in pixel coordinates.
        extent_m: standard deviation of a marker's depth about the centroid of its hand, metres: fingertips seen by one
            camera are 0.026 behind it, plus or minus 0.027 (15 develop rigs).
        lost_periods: a marker not observed for this many frame periods is not moved by a single view.
        measured_m: upper bound of the standard deviation of a point in state `measured`, metres (root of the
            covariance's trace, including hidden paint but not the calibration error), beyond the uncertainty of any
            pair of views; the width of a little finger's tip, because a less certain point may be the neighbouring
            finger. No other indicator predicted the error better: neither the visible area, its changes, its difference
            between cameras, nor all of them combined (15 develop rigs at 15, 30 and 60 fps). At 0.0125 instead of
            0.011, 20 rendered sequences have a live coverage of 94.7 instead of 94.2 %, smoothed 97.7 instead of
            97.3 %, and a 95th percentile of 5.3 instead of 5.1 mm, smoothed 4.6 instead of 4.4; the same trade at 0.014
            and 0.016. 30 develop rigs have a coverage of 97.2 instead of 96.7 % at 60 fps, and a 95th percentile of
            7.83 instead of 7.74 mm.
        uncalibrated_measured_m: the same in uncalibrated rigs: four pixels, at 2 cm of depth per pixel.
        lost_m: a marker with a larger standard deviation is not published, and is deleted once no camera sees it,
            metres. The limit is generous because slow unsynchronised cameras (15 fps) initialise markers with a large
            depth uncertainty, and a smaller limit deleted them at once.
        replay_s: frames that arrive later than this after a newer one are discarded, seconds.
    """

    gate: float = 25.0
    inflation_gate: float = 9.0
    reacquisition_gate: float = 6.0
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
    depth_markers: int = 1
    ray_reach_m: float = 0.2
    loose_m: float = 0.03
    extent_m: float = 0.037
    lost_periods: float = 2.5
    measured_m: float = 0.0125
    uncalibrated_measured_m: float = 0.08
    lost_m: float = 0.12
    replay_s: float = 0.06


@dataclass(frozen=True, slots=True)
class PaintSettings:
    """Model of the visible paint; see `paint`.

    Attributes:
        compare_s: areas observed further apart in time are not compared, seconds.
        settle_s: time constant of the low-pass filter of the compared widths while they change by less than `uneven`,
            seconds. Larger changes are followed without delay: a lag of 0.03 caused 20 mm of depth error within 0.1 s
            for a thumb that one camera lost first. On 15 develop rigs, three simulated hands and the rendered pictures,
            0.03 and 0.1 give the same errors; longer values reduce jitter at rest.
        uneven: relative difference of area between views of an unoccluded marker, caused by the camera positions.
        rim_px: and its absolute difference at the rim, pixels: a quarter of a pixel of its radius.
        doubtful: a difference of this many times that of an unoccluded marker is attributed to occlusion by half;
            smaller ones by less, larger ones almost entirely. Compared with a dead zone of the same width, 1 and 1.5
            give 79 and 86 swapped points instead of 102 on 15 develop rigs, and 29 and 22 false points instead of 31 in
            six simulated scenes. Medians are equal at 1.5 and 0.1 mm larger at 1.
        cut: standard deviation of the centroid of a marker cut off by the image border, as a share of the missing
            width: markers are not upright squares.
        shift: displacement of the centroid, as a share of the occluded width: a strip displaces it by half of itself.
        doubt: standard deviation of this displacement, in the same unit.
        lasts_s: correlation time of its error, seconds: a finger passes behind another one, 15 mm at 0.15 m/s. If the
            error were white, the remaining strip of paint would become depth and velocity, however large the noise of
            each frame. Between 0.1 and 0.3 there is no difference on eight develop rigs; smoothed pictures are 1.5 mm
            worse at 0.3.
        side: (π/4) ρ of `paint`.
        shaft: λ of `paint`: tips are painted over 15 to 20 mm and are 6 to 7 mm thick.
        first_bend: c of a relaxed finger, bent away from the camera by a quarter of a right angle or a little more.
        most_bend: below this c (45 degrees) a small area indicates occlusion rather than a bent finger; between −0.7
            and −0.8 the same within 0.1 mm on rendered pictures and two simulated hands.
        appears_s: time constant of the width with which the visible width is compared, seconds: two frames at 60 fps.
        appearing: standard deviation of the centroid of a marker that becomes visible from behind an occluder, as a
            share of its width: at the median half of it is still hidden. Between 0.1 and 0.25 there is no difference.
        sliver: below this share of its largest visible area, cameras see different parts of a fingertip.
        sliver_doubt: standard deviation of the centroid of such a part, as a share of the whole width, for the smallest
            ones. The difference of two cameras' centroids was 0.12, 0.05 and 0.02 of the width (root mean square) for
            shares up to 0.15, 0.3 and 0.45 (rendered pictures). With it, 14 rendered sequences have a 95th percentile
            of 5.1 instead of 5.3 mm, and three fast simulated hands 31 instead of 38 false points.
        skin_s, skin_lasts_s: time constant with which the direction to adjoining skin is averaged, and for how long it
            is used, seconds. Between 0 and 0.08 the errors are the same.
        least_skin: shortest mean vector to adjoining skin that is used: half of that of a straight finger, whose skin
            adjoins along 70 to 90 degrees. Between 0.1 and 0.15 the errors are the same.
        seen_first: weight of the first observed area, against the area of the nominal paint length, in the initial
            estimate of a marker's largest area. Between 0 and 0.5 there is no difference on rendered and simulated
            hands; 1 is 0.4 mm worse on the latter.
        curled, straight: the direction of a finger's end is used in proportion to how far the finger extends, from
            nothing at `curled` to fully at `straight`, as shares of the distance from knuckle to straight tip. On 15
            develop rigs (60 fps, side correction compared with the truth) the best factors are −0.2, 0.3, 0.6, 1.1
            and 0.9 at 0.51, 0.63, 0.78, 0.86 and 0.97 of that distance; 0.05 less makes no difference. The
            correction is conservative, because a small area is more often caused by occlusion.
        most_turned: smallest share of its area that a patch shows because it is turned: that of 60 degrees, beyond
            which the back of the hand is seen edge-on. Anything less is occlusion.
        found: share of a tip's area that is detected as its colour; pixels at the rim are mixed with the background.
        hidden: standard deviation of a tip's centre, each axis, for paint hidden from all cameras, as a share of the
            width that is missing beyond `most_bend`. On 15 develop rigs at 60 fps, 66, 30, 25
            and 14 % of normalised errors exceeded the 95 % quantile of chi-square where the fullest view showed 0.15 to
            0.2, 0.2 to 0.3, 0.3 to 0.4 and 0.4 to 0.6 of the largest area; with this term 5, 9, 11 and 10 %.
        slack_px, slack: extra width of a gate beyond the filter's covariance, pixels and a share of the marker's width:
            half of a tip may become hidden within one frame.
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
    sliver: float = 0.4
    sliver_doubt: float = 0.04
    skin_s: float = 0.04
    skin_lasts_s: float = 0.1
    least_skin: float = 0.1
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
    """Terms added to covariances for systematic errors, which cannot be estimated from frames; see `systematic`.

    Attributes:
        doubt: factor applied to the stated calibration error: it is stated for the image centre and is three times as
            large near the border (simulated calibrations of 30 rigs, `rhot evaluate motion`).
        across: share of the squared calibration error along each axis perpendicular to the viewing ray; the rest is
            depth. With a baseline of an eighth of the distance, depth is eight times less accurate than the lateral
            position; this share is larger, to allow for lens distortion.
        shape: standard deviation of a fingertip's centre due to its paint and the visible side, each axis, as a share
            of its radius: 1 of 6.5 mm. At 0.3, 83 and 98 % of the errors of eight develop rigs at 60 fps lie within one
            and two stated sigma; at 0.15, 72 and 96 %.
    """

    doubt: float = 1.6
    across: float = 0.15
    shape: float = 0.15


@dataclass(frozen=True, slots=True)
class BridgeSettings:
    """Connection, in smoothing, of a marker with where it is initialised anew.

    Attributes:
        lasts_s: longest time between, seconds.
        scale: noise intensity of its motion between, m/s^1.5; a fast hand, see `MotionSettings.scales`.
        gate: squared Mahalanobis distance (6 degrees of freedom) beyond which the marker's covariance is inflated;
            exceeded by chance once in 1000.
    """

    lasts_s: float = 0.25
    scale: float = 5.0
    gate: float = 22.5


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """All parameters of the filter."""

    motion: MotionSettings = MotionSettings()
    noise: NoiseSettings = NoiseSettings()
    track: TrackSettings = TrackSettings()
    paint: PaintSettings = PaintSettings()
    systematic: SystematicSettings = SystematicSettings()
    bridge: BridgeSettings = BridgeSettings()


DEFAULT: Final = FilterSettings()
