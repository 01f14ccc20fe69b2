"""Parameters of the hand estimate: one field each, with unit and provenance."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class HandSettings:
    """Numbers of the estimate of one hand.

    Attributes:
        acceleration: random acceleration of the wrist, m/s² per √Hz. Hands in the recordings reach 5 to 20 m/s² for
            some 0.1 s (`rhot evaluate motion`); fusion has smoothed the points already, so the wrist is to follow them.
        turn_acceleration: the same of its rotation, rad/s² per √Hz: 50 rad/s² for 0.1 s.
        speed_fades_s: an unseen wrist stops in this time: voluntary movements are bells of about half a second.
        angles_s: time constant with which an unseen finger comes to be anywhere that fingers are: people hold a thing,
            or a posture, for some seconds.
        closing_s: the same of one that closes round a known thing: in front of cameras that see a hand's back, fingers
            vanish under it because they close, which takes about half a second.
        most_activity: fingers that move faster than they usually do get up to this many times their diffusion. A
            finger turns at most at some 20 rad/s, usually at 2 to 4.
        person_s: in this time what was learned of a person fades: somebody may have changed places or repainted.
        lasts_s: errors of the points last about so long (fusion's own memory, a posture in which the paint that is seen
            lies off its middle), so that only one sample in this time tells something new of a person.
        first_lasts_s: what the very first sample tells of a person counts as one that comes this much later.
        base_shift_m: how far the patch sits from where the model has it, standard deviations across, above and along
            the hand. A hand's back is 11 to 18 mm above the wrist's joint; people paint by eye, 8 mm along the hand;
            and palms of hands of one length differ by 4.5 mm.
        palm_share: a patch that seems to sit nearer to the knuckles may as well be on a palm that is shorter than the
            model's; nothing that is seen tells these apart. The share of the palm in their variance: of its 93 mm, the
            65 mm of the metacarpal differ by 5 to 8 % in people whose hands have one length (see finger_share), which
            is 4.5 mm.
        patch_tilt_rad: by how much the skin under the patch is tilted against the palm, each axis.
        finger_share: how much longer or shorter than the model's a finger is up to its marker: 2 to 3 mm of 80 mm for
            the length of the paint, and 3 to 4 % for three bones in a row, each 5 to 8 % by itself in people whose
            hands have one length (Buryanov & Kotiuk 2010, tables 1 to 3: standard deviations of each bone).
        known_m, known_rad, known_share: the same three where `rhot calibrate hand` has measured them, as its quality
            states them.
        model_m: by how much any marker departs from a rigid model for reasons that come and go, each axis: skin slides
            over knuckles by millimetres, the middle of the paint that is seen wanders with the view.
        corner_factor: covariance of a patch's corner about its middle over that of the middle, before anything is
            known. Corners are found half as surely as centroids (0.2 px beside 0.1, rendered G1) and come
            unfiltered: (2 · 2)².
        corner_samples: the first sample counts one part in so many, so that the guess, which is one of order only, is
            worth a single sample; and how many are remembered.
        corner_m: and at least this, each axis: the fitted corners of soft-edged paint.
        across_rad: error of the direction across the wrist, where two points of the wrist tell it.
        sigma_m: of a point that states no covariance, root of the sum of the three variances.
        far_m: a tip further than this from where it was expected is first looked for in closed form.
        contact_m: how far fingers sink into what they hold, or its shape is off.
        close_rad: steps end when the derivatives were taken this near to where they led.
        outlier: a tip that many standard deviations off loses weight.
        turn_outlier: a patch's rotation that many standard deviations off loses weight, with the fourth power of it. Of
            those 30 to 45° off what was expected half were wrong by over 15°, beyond that 61 % by over 30° (fast hands
            of `rhot evaluate motion`, 30 fps, develop seeds 0 to 29): cameras out of step, another order of corners.
        miss_m: and one that no pose within the limits meets within this.
        gap_s: after a silence this long nothing of the past is used.
        late_s: a sample that is older than the last one by less than this came out of order and is left out.
        lost_m, lost_s: when the seen tips miss the model by more than this on average for this long, the hand is
            looked for again: more than wrong proportions explain, for longer than a wild marker lasts.
        unconfirmed_m: the same limit while the corners of no patch have confirmed the palm.
        quarter_turn: a palm whose patch would fit this much better a quarter turn off (difference of two chi-squares:
            odds of e¹⁰) is turned.
        lost_haste: time counts up to this many times, with the square of how many times as much they miss it.
    """

    acceleration: float = 6.0
    turn_acceleration: float = 15.0
    speed_fades_s: float = 0.2
    angles_s: float = 2.0
    closing_s: float = 0.8
    most_activity: float = 30.0
    person_s: float = 60.0
    lasts_s: float = 0.25
    first_lasts_s: float = 0.1
    base_shift_m: tuple[float, float, float] = (0.005, 0.004, 0.0092)
    palm_share: float = 0.24
    patch_tilt_rad: float = 0.09
    finger_share: float = 0.05
    known_m: float = 0.001
    known_rad: float = 0.02
    known_share: float = 0.005
    model_m: float = 0.0022
    corner_factor: float = 16.0
    corner_samples: tuple[float, float] = (2.0, 100.0)
    corner_m: float = 0.001
    across_rad: float = 0.05
    sigma_m: float = 0.0015
    far_m: float = 0.015
    contact_m: float = 0.002
    close_rad: float = 0.05
    outlier: float = 10.0
    turn_outlier: float = 3.0
    miss_m: float = 0.012
    gap_s: float = 1.0
    late_s: float = 0.1
    lost_m: float = 0.012
    lost_s: float = 0.3
    unconfirmed_m: float = 0.006
    quarter_turn: float = 20.0
    lost_haste: float = 20.0
