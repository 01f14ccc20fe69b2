"""The filter of the whole hand: state, prediction, measurement, update and initialisation."""
