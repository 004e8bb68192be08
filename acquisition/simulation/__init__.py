"""Simulated devices: separate processes that speak the real devices' protocols."""

from acquisition.simulation.process import SimulatorProcess

__all__ = ["SimulatorProcess"]
