"""Ticks to Rerun: the only room that imports rerun.

Secrets: the picture plane (scene), colours (palette), speed maps and their scale (maps), arrows, names (entities),
what is logged when (log), the layout (blueprint), the file (rrd), the live view's process and its queue (live, feed),
where the viewer is and whether there is a screen (viewer), pictures without a screen (screenshot).
"""

from flowrec.view.live import LiveView
from flowrec.view.rrd_file import is_made_from, write_rrd
from flowrec.view.scene import Scene
from flowrec.view.screenshot import screenshot
from flowrec.view.viewer import open_viewer

__all__ = ["LiveView", "Scene", "is_made_from", "open_viewer", "screenshot", "write_rrd"]
