from .console import Console as Console, refuse_without_packages as refuse_without_packages
from .messages import RunEnded as RunEnded
