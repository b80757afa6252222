"""Side-scan sonar snippets from an underwater vehicle, through an acoustic modem, to a vessel and a shore site.

>>> import sonarpost
>>> stream = sonarpost.encode(image, budget=64)
>>> image = sonarpost.decode(stream)

The names of this package are the public interface; they follow semantic versioning. Every other module may change
without notice. Names are imported on first use: `import sonarpost` alone loads no library.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sonarpost.codec import (
        Codec,
        DecodedImage,
        StreamHeader,
        codec_names,
        decode,
        decode_image,
        encode,
        get_codec,
    )
    from sonarpost.detection.detector import Detection, detect
    from sonarpost.detection.settings import DetectorSettings
    from sonarpost.errors import BadInputError, SonarpostError
    from sonarpost.link.frames.paper.receiver import PaperReceiver
    from sonarpost.link.frames.paper.sender import PaperSender
    from sonarpost.link.frames.v1.receiver import V1Receiver
    from sonarpost.link.queue.transmit_queue import TransmitQueue
    from sonarpost.link.receiver import FrameReceiver
    from sonarpost.link.sender import ImageSender
    from sonarpost.messages import (
        Command,
        Contact,
        Decision,
        EncodedImage,
        OutgoingMessage,
        Pixels,
        ReconstructedImage,
        Snippet,
    )
    from sonarpost.modem.micromodem import MicroModem, MicroModemConfig
    from sonarpost.runtime.serial_modem import SerialModem
    from sonarpost.sonar.image_files import read_image, write_png
    from sonarpost.sonar.options import SurveyOptions
    from sonarpost.sonar.readers import open_survey
    from sonarpost.sonar.source import SurveySource
    from sonarpost.sonar.survey import Ping, Survey
    from sonarpost.wire import decode as decode_record
    from sonarpost.wire import encode as encode_record

__version__ = "0.3.0"

_HOMES = {
    "codec": "Codec DecodedImage StreamHeader codec_names decode decode_image encode get_codec",
    "detection.detector": "Detection detect",
    "detection.settings": "DetectorSettings",
    "errors": "BadInputError SonarpostError",
    "link.frames.paper.receiver": "PaperReceiver",
    "link.frames.paper.sender": "PaperSender",
    "link.frames.v1.receiver": "V1Receiver",
    "link.queue.transmit_queue": "TransmitQueue",
    "link.receiver": "FrameReceiver",
    "link.sender": "ImageSender",
    "messages": "Command Contact Decision EncodedImage OutgoingMessage Pixels ReconstructedImage Snippet",
    "modem.micromodem": "MicroModem MicroModemConfig",
    "runtime.serial_modem": "SerialModem",
    "sonar.image_files": "read_image write_png",
    "sonar.options": "SurveyOptions",
    "sonar.readers": "open_survey",
    "sonar.source": "SurveySource",
    "sonar.survey": "Ping Survey",
    "wire": "decode_record encode_record",
}
_MODULES = {name: module for module, names in _HOMES.items() for name in names.split()}
_RENAMED = {"decode_record": "decode", "encode_record": "encode"}

__all__ = [
    "BadInputError",
    "Codec",
    "Command",
    "Contact",
    "Decision",
    "DecodedImage",
    "Detection",
    "DetectorSettings",
    "EncodedImage",
    "FrameReceiver",
    "ImageSender",
    "MicroModem",
    "MicroModemConfig",
    "OutgoingMessage",
    "PaperReceiver",
    "PaperSender",
    "Ping",
    "Pixels",
    "ReconstructedImage",
    "SerialModem",
    "Snippet",
    "SonarpostError",
    "StreamHeader",
    "Survey",
    "SurveyOptions",
    "SurveySource",
    "TransmitQueue",
    "V1Receiver",
    "codec_names",
    "decode",
    "decode_image",
    "decode_record",
    "detect",
    "encode",
    "encode_record",
    "get_codec",
    "open_survey",
    "read_image",
    "write_png",
]


def __getattr__(name: str) -> object:
    """Import a public name on first use."""
    if name not in _MODULES:
        raise AttributeError(f"module 'sonarpost' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"sonarpost.{_MODULES[name]}"), _RENAMED.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names as well, also those that are not imported yet."""
    return sorted({*globals(), *__all__})
