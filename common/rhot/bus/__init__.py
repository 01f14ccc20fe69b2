"""The bus: one small asyncio layer over Eclipse Zenoh.

Realtime keys are newest-wins from end to end: published with congestion control *drop*, received into latest-only
slots. Control and configuration are reliable and never dropped. Every published key also answers a query with its
last value.
"""

from rhot.bus.publisher import Publisher
from rhot.bus.query import Answer, Reply, Request, TimedAnswer, json_answer, message_answer
from rhot.bus.session import CONNECT_S, Bus
from rhot.bus.subscriber import EventSubscriber, LatestSubscriber, Sample
from rhot.bus.zenoh_config import session_config

__all__ = [
    "CONNECT_S",
    "Answer",
    "Bus",
    "EventSubscriber",
    "LatestSubscriber",
    "Publisher",
    "Reply",
    "Request",
    "Sample",
    "TimedAnswer",
    "json_answer",
    "message_answer",
    "session_config",
]
