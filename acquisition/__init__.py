"""Devices, their clocks, and recording: from a rig file to a session. Imports `dataset` alone.

The outside uses `rig` (what a lab has), `capture` (what it records), `recorder`, `camera` and `robot` (what a
device must do), `clocks`, `trajectories`, `routes` and `dry_run` (where the arm will go), and `simulation`
(devices for those who have none).
"""
