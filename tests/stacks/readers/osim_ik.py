"""Runs OpenSim's inverse kinematics: osim_ik.py MODEL TRC OUT START_S END_S > JSON of angles, degrees, and errors."""

import json
import os
import sys
from pathlib import Path

import opensim

model, trc, out, start_s, end_s = sys.argv[1:]
os.chdir(Path(out).parent)
opensim.Logger.setLevelString("error")
tool = opensim.InverseKinematicsTool()
tool.set_model_file(model)
tool.set_marker_file(trc)
tool.set_output_motion_file(out)
tool.set_report_errors(True)
tool.set_accuracy(1e-8)
tool.setStartTime(float(start_s))
tool.setEndTime(float(end_s))
assert tool.run()
found = opensim.TimeSeriesTable(out)
degrees = {name: list(found.getDependentColumn(name).to_numpy()) for name in found.getColumnLabels()}
errors = opensim.TimeSeriesTable(str(next(Path().glob("*_ik_marker_errors.sto"))))
worst = float(max(errors.getDependentColumn("marker_error_max").to_numpy()))
json.dump({"degrees": degrees, "worst_m": worst}, sys.stdout)
