"""Which matches of two images a rigid scene explains, and by which geometry."""

from sfm.verification.two_view import VerificationConfig
from sfm.verification.verify import verify_pair

__all__ = ["VerificationConfig", "verify_pair"]
