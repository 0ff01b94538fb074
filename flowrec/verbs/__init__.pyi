from .check import check as check
from .cli import main as main
from .command import (
    CommandLineError as CommandLineError, MisuseError as MisuseError, Told as Told, usage_line as usage_line, verb as verb,
)
from .listed import (
    ALWAYS as ALWAYS, LISTS as LISTS, ListedSession as ListedSession, TEXT_LIMIT as TEXT_LIMIT,
    columns_for_people as columns_for_people, columns_of as columns_of, text_of_list as text_of_list, kind_of as kind_of,
)
from .listing import NAMES as NAMES, describe as describe, read_each as read_each, runs_of as runs_of
from .options import (
    AsJson as AsJson, Asked as Asked, FiniteNumbers as FiniteNumbers, HELP_WIDTH as HELP_WIDTH, HTML as HTML, Overwrite as Overwrite, SetTexts as SetTexts,
    Stoppable as Stoppable, WholeDescriptions as WholeDescriptions, require_packages as require_packages,
)
from .preparation import prepare as prepare, refuse_adrift as refuse_adrift
from .replay_change import Change as Change, FIXED as FIXED
from .replay_made import refly as refly
from .replay_result import refinement_remarks as refinement_remarks
from .session_replay import replay_session as replay_session
from .session_table import (
    AS_LIST as AS_LIST, SessionTable as SessionTable, SqlError as SqlError, connect as connect,
    first_line as first_line,
)
