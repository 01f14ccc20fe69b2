"""Reads a file of markers or angles with OpenSim: osim.py FILE ROW > JSON."""

import json
import sys

import opensim

path, row = sys.argv[1], int(sys.argv[2])
vectors = path.endswith(".trc")
table = (opensim.TimeSeriesTableVec3 if vectors else opensim.TimeSeriesTable)(path)
values = table.getRowAtIndex(row)
names = list(table.getColumnLabels())
found = {n: [values[k][axis] for axis in range(3)] if vectors else values[k] for k, n in enumerate(names)}
json.dump({"time": table.getIndependentColumn()[row], "values": found}, sys.stdout)
