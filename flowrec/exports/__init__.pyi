from .export import export as export, format_of as format_of, kept_rrd as kept_rrd
from .formats import EXPORTS as EXPORTS
from .layout import write_layouts as write_layouts
from .report import style as style
from .report.curve_figures import (
    MotionFigure as MotionFigure, ObserverFigure as ObserverFigure, PathFlowFigure as PathFlowFigure,
    RecordingFigure as RecordingFigure, TrackFigure as TrackFigure,
)
from .report.curves import Span as Span
from .report.explanations import GLOSSARY as GLOSSARY, MEANINGS as MEANINGS, sentence as sentence
from .report.map_figure import ChangeFigure as ChangeFigure, MapFigure as MapFigure
from .report.page import (
    Drawn as Drawn, Folded as Folded, Page as Page, ReplayPart as ReplayPart, ReportFigure as ReportFigure,
    ReportTable as ReportTable, SweepPage as SweepPage, as_uri as as_uri, draw_figure as draw_figure, render as render,
)
from .report.path_figure import PathFigure as PathFigure
from .report.report_data import ReportData as ReportData
from .report.timeline_figure import TimelineFigure as TimelineFigure, numbered_actions as numbered_actions
from .rrd import RrdExport as RrdExport, scene_of as scene_of
