"""The quality of an update: correlation, identifiability, localisation, validation, posterior."""

from .correlation import Correlation as Correlation
from .correlation import correlate as correlate
from .correlation import fdac as fdac
from .correlation import frac as frac
from .correlation import mac as mac
from .identifiability import Identifiability as Identifiability
from .identifiability import identifiability as identifiability
from .localise import Localisation as Localisation
from .localise import localise as localise
from .posterior import Posterior as Posterior
from .posterior import sample_posterior as sample_posterior
from .validation import Validation as Validation
from .validation import split as split
from .validation import validate as validate
