"""Submission to Result: the metrics, a file per family, and the protocol that fixes every choice (docs/protocol.md)."""

from splashbench.score.metrics import METRICS, Metric
from splashbench.score.protocol import score_submission, shared_fields
from splashbench.score.result import MetricValue, Result
from splashbench.score.settings import PROTOCOL_V1, Protocol

__all__ = [
    "METRICS",
    "PROTOCOL_V1",
    "Metric",
    "MetricValue",
    "Protocol",
    "Result",
    "score_submission",
    "shared_fields",
]
