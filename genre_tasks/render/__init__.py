"""Rendering of Gaussians: one function, several backends."""

from genre_tasks.render.api import render, render_views
from genre_tasks.render.types import Cameras, Render, RenderSettings

__all__ = ["Cameras", "Render", "RenderSettings", "render", "render_views"]
