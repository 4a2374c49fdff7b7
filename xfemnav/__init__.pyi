from .errors import XfemnavError as XfemnavError
from .errors import XfemnavWarning as XfemnavWarning
from .pipeline.result import Result as Result
from .pipeline.result import run as run
from .pipeline.session import Session as Session

__version__: str
