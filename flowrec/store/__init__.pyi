from .audit import Audit as Audit, audit as audit, digest_faults as digest_faults
from .bucket_upload import (
    Bucket as Bucket, Content as Content, StoreError as StoreError, content_of_file as content_of_file,
)
from .byte_source import is_there as is_there, open_bytes as open_bytes, size_of as size_of
from .channels import FRAME_PATH as FRAME_PATH, SLOTS as SLOTS, is_left_out as is_left_out
from .growing_run import GrowingRun as GrowingRun, live_runs as live_runs
from .lookup import is_copy as is_copy
from .mcap_format import ForeignError as ForeignError
from .notes import NOTES_SUFFIX as NOTES_SUFFIX, Note as Note, notes_content as notes_content, notes_file as notes_file
from .reader import SessionReader as SessionReader
from .recovery import Recovered as Recovered, recover as recover, recover_run as recover_run
from .remote_file import (
    RemoteFile as RemoteFile, files_at as files_at, forget as forget, is_listed as is_listed,
    objects_in as objects_in,
)
from .roi import nonzero_window as nonzero_window
from .run_files import (
    PARTIAL_SUFFIX as PARTIAL_SUFFIX, Run as Run, SESSION_SUFFIX as SESSION_SUFFIX,
    continuity_fault as continuity_fault, existing_session as existing_session, files_behind as files_behind, files_of as files_of,
    is_continued as is_continued, is_snapshot as is_snapshot, part_number as part_number, part_path as part_path,
    run_files as run_files, run_path as run_path, runs_in as runs_in, session_sha256 as session_sha256,
)
from .session import (
    Session as Session, input_blamed as input_blamed, open as open, toml_table as toml_table,
)
from .session_file import WriterOptions as WriterOptions
from .session_metadata import (
    Part as Part, SessionHeader as SessionHeader, SessionMetadata as SessionMetadata,
    is_header_file as is_header_file,
)
from .session_path import (
    UrlPath as UrlPath, named_beside as named_beside, on_this_machine as on_this_machine,
    session_path as session_path,
)
from .session_writer import (
    cut_session as cut_session, frames_of as frames_of, image_bytes_s as image_bytes_s, session_header as session_header,
    session_writer as session_writer,
)
from .signature import (
    refuse_unusable_key as refuse_unusable_key, sign_file as sign_file, signature_file as signature_file,
    verify_file as verify_file,
)
from .table_columns import Column as Column, columns_of as columns_of, observations_of as observations_of
from .tables import (
    field_values as field_values, observed_flow as observed_flow, sample_batches as sample_batches,
    sample_schema as sample_schema,
)
from .traffic import (
    HiddenError as HiddenError, MissingError as MissingError, RefusedError as RefusedError,
    TIMEOUT_KEY as TIMEOUT_KEY, TRAFFIC as TRAFFIC, TransientError as TransientError,
)
from .viewer_scene import HEIGHT as HEIGHT, LENGTHS as LENGTHS
from .viewer_topics import VERDICT as VERDICT
from .writer import SessionWriter as SessionWriter
