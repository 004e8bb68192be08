"""Simulated devices: separate processes that speak the real devices' protocols."""
