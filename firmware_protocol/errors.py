"""The one error of the codec."""


class ProtocolError(ValueError):
    """Bytes that are no valid frame, or a message whose fields the wire or the limits do not allow."""
