"""Training sets: rendered polarization images with exact poses, masks and boxes."""

from s2p3.synthesis.domain import SYNTHETIC, Domain, Views, draw_scene, draw_view
from s2p3.synthesis.generate import draw_frame, session_camera, synthesize
from s2p3.synthesis.informativeness import Informativeness
from s2p3.synthesis.scene import SceneImage, SceneParameters, render_scene

__all__ = [
    "SYNTHETIC",
    "Domain",
    "Informativeness",
    "SceneImage",
    "SceneParameters",
    "Views",
    "draw_frame",
    "draw_scene",
    "draw_view",
    "render_scene",
    "session_camera",
    "synthesize",
]
