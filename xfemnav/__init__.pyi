from .errors import XfemnavError as XfemnavError
from .errors import XfemnavWarning as XfemnavWarning
from .pipeline.running.result import Result as Result
from .pipeline.running.result import run as run
from .pipeline.running.session import Session as Session

__version__: str
