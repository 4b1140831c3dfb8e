"""One line instead of a page where torchcodec, LeRobot's first choice of video decoder, finds no FFmpeg.

LeRobot tries it whenever a training configuration is parsed, logs the traceback of each attempt, and then uses PyAV.
"""

import logging


class _Shorten(logging.Filter):
    def __init__(self):
        super().__init__()
        self.said = False

    def filter(self, record: logging.LogRecord) -> bool:
        if "libtorchcodec" not in record.getMessage():
            return True
        record.msg, record.args = "torchcodec finds no FFmpeg libraries; videos are decoded by PyAV instead.", ()
        first, self.said = not self.said, True
        return first


def shorten_torchcodec_warning() -> None:
    """Install the filter on the loggers that the message comes from."""
    for name in ("lerobot.utils.import_utils", "lerobot.datasets.video_utils"):
        logging.getLogger(name).addFilter(_Shorten())
