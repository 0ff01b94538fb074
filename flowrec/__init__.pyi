__version__: str

from .core.errors import FlowrecError as FlowrecError
from .rigs.streams.log import RunLog as RunLog
from .run.replay_figures import before_after as before_after
from .stages.config import Config as Config
from .stages.config import load_config as load_config
from .store.recovery import recover as recover
from .store.session import Session as Session
from .store.session import open as open
from .verbs.check import check as check
from .verbs.compare import compare as compare
from .verbs.cut import cut as cut
from .verbs.export import export as export
from .verbs.import_movie import import_movie as import_movie
from .verbs.info import info as info
from .verbs.record import record as record
from .verbs.replay import replay as replay
from .verbs.replay_change import Change as Change
from .verbs.replay_result import Replay as Replay
from .verbs.report import report as report
from .verbs.user_flow import refine as refine
from .verbs.user_flow import solve as solve
