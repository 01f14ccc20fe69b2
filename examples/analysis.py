"""From a recording to a figure and files for an archive: `python analysis.py grasp.mcap`.

Record one with `rhot record --out grasp.mcap --duration 20` while `rhot sim` or your own rig runs, and mark its trials
with `rhot mark grasp`. Needs matplotlib and `pip install 'rhot[sim,archives]'`.
"""

import subprocess
import sys

import matplotlib as mpl
import numpy as np

import rhot

mpl.use("Agg")
from matplotlib import pyplot as plt

recorded = sys.argv[1]
smooth = rhot.track(None, recorded, smooth=True).resampled(100.0)
hand = smooth.hands["right"]
tip = hand.joint("index_tip")
sigma = hand.sigma[:, hand.joint_names.index("index_tip")]
aperture = np.linalg.norm(tip - hand.joint("thumb_tip"), axis=1)

figure, (path, angles, grip) = plt.subplots(3, sharex=True, figsize=(8, 7))
path.fill_between(hand.t, 1e3 * (tip[:, 2] - sigma), 1e3 * (tip[:, 2] + sigma), alpha=0.3)
path.plot(hand.t, 1e3 * tip[:, 2])
path.set_ylabel("index tip, depth, mm")
for name in ("index_mcp_flexion", "index_pip_flexion"):
    angles.plot(hand.t, np.degrees(hand.angle(name)), label=name)
angles.set_ylabel("flexion, degrees")
angles.legend()
grip.plot(hand.t, 1e3 * aperture)
grip.set(xlabel="t, s", ylabel="grip aperture, mm")
for event in smooth.events:
    grip.axvline(1e-9 * (event.t_ns - smooth.start_ns), linestyle=":")
figure.savefig("analysis.png", dpi=150)

subprocess.run(["rhot", "export", recorded, "--nwb", "analysis.nwb", "--bids", "dataset"], check=True)
subprocess.run(["rhot", "report", recorded, "--out", "report.html"], check=True)
