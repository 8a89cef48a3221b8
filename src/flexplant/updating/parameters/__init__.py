"""What an update may change: masses, springs and dampers at places, parts of the matrices."""

from .added import AddedDamping as AddedDamping
from .added import AddedMass as AddedMass
from .added import AddedStiffness as AddedStiffness
from .added import Parameter as Parameter
from .matrix_parameters import MatrixParameter as MatrixParameter
from .matrix_parameters import ModeDamping as ModeDamping
from .polynomial import PolynomialParameter as PolynomialParameter
