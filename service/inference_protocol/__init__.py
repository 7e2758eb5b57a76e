"""The Open Inference Protocol v2 over HTTP, as KServe and Triton clients speak it, in front of the same endpoint.

One input, `points` FP32 [-1, 3]; options in `parameters`, each as JSON or as a string that holds JSON or a plain word;
outputs named as in the .npz. Tensors travel as JSON or, by the binary tensor extension, as raw little-endian bytes
behind the JSON, whose length `Inference-Header-Content-Length` tells.
"""

from service.inference_protocol.routes import inference_protocol

__all__ = ["inference_protocol"]
