from .console import (
    Console as Console, RunEnded as RunEnded, refuse_without_packages as refuse_without_packages,
)
