"""Read pictures as a check of the rig sees them: every one counts, and a damaged one is an error."""

from collections.abc import Iterator

from pipeline.calibration.model import Calibration
from pipeline.decoder import Decoder
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import FootageError
from pipeline.footage.footage import BadFrame, Footage
from pipeline.models import CodeName, ImageArray
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.linearization import Transfer


class PictureReader:
    """Reads frames and decodes them; what the settings leave open, the calibration states."""

    def __init__(self, source: Footage, calibration: Calibration, settings: DecodeSettings, arch: str) -> None:
        self.calibration = calibration = calibration.as_read_out(source.size_px, source.sensor, source.name)
        if calibration.pattern is not None and "stripes" not in settings.model_fields_set:
            settings = settings.replace(stripes=calibration.pattern.stripes)
        at_calibration = None if calibration.capture is None else calibration.capture.transfer
        self.transfer: Transfer = settings.transfer or "linear"
        if settings.transfer is None and at_calibration is not None:
            self.transfer = at_calibration
        self._source, self._stripes = source, settings.stripes
        self._decoder = Decoder(settings, calibration, arch=arch)

    @property
    def code(self) -> CodeName | None:
        """The pattern's code, by all that has been read."""
        return self._decoder.state.code

    @classmethod
    def of_one(cls, source: Footage, calibration: Calibration, settings: DecodeSettings, arch: str) -> "PictureReader":
        """Return a reader of one picture.

        Raises
        ------
        FootageError
            There are several.
        """
        if len(source) != 1:
            raise FootageError(f"{source.name} holds {len(source)} frames: give one picture, or a folder of frames")
        return cls(source, calibration, settings, arch)

    def frames(self) -> Iterator[tuple[ImageArray, DecodedFrame]]:
        """Yield every picture as developed levels (H, W, 3), and decoded.

        Raises
        ------
        FootageError
            One cannot be read.
        """
        for stored in self._source.frames():
            if isinstance(stored, BadFrame):
                raise FootageError(stored.reason)
            image = runtime.to_host(develop(stored.planes, stored.format, stripes=self._stripes))
            yield image, self._decoder.decode(image)
