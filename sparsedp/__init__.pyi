from . import check as check
from . import errors as errors
from . import interop as interop
from . import network as network
from . import report as report
from .advection.transport import transport as transport
from .autodiff.derivative import grad as grad
from .autodiff.derivative import hvp as hvp
from .autodiff.derivative import jvp as jvp
from .autodiff.derivative import value_and_grad as value_and_grad
from .autodiff.derivative import vjp as vjp
from .autodiff.flattening import flatten as flatten
from .autodiff.jit import jit as jit
from .autodiff.tape import differentiable as differentiable
from .flow.finite_volumes import conservation_law as conservation_law
from .flow.flow_step import flow_step as flow_step
from .flow.momentum import convection as convection
from .flow.momentum import face_laplacian as face_laplacian
from .flow.momentum import face_lift as face_lift
from .flow.obstacles import brinkman as brinkman
from .flow.obstacles import forces as forces
from .flow.pressure_projection import projection as projection
from .grid.boundary_conditions import dirichlet as dirichlet
from .grid.boundary_conditions import free_slip as free_slip
from .grid.boundary_conditions import inflow as inflow
from .grid.boundary_conditions import neumann as neumann
from .grid.boundary_conditions import no_slip as no_slip
from .grid.boundary_conditions import outflow as outflow
from .grid.boundary_conditions import patch as patch
from .grid.boundary_conditions import robin as robin
from .grid.grid import Grid as Grid
from .grid.space import Space as Space
from .integrators.leapfrog import sponge as sponge
from .integrators.stepper import stepper as stepper
from .interop.blackbox import from_blackbox as from_blackbox
from .io.archive import load as load
from .io.archive import save as save
from .io.pictures import from_image as from_image
from .kernels import set_threads as set_threads
from .operators.difference import curl as curl
from .operators.difference import divergence as divergence
from .operators.difference import flux as flux
from .operators.difference import gradient as gradient
from .operators.difference import laplacian as laplacian
from .operators.difference import upwind as upwind
from .operators.given import from_functions as from_functions
from .operators.given import from_linear_operator as from_linear_operator
from .operators.given import from_matrix as from_matrix
from .operators.harmonic import harmonic_average as harmonic_average
from .operators.masks_and_lift import diagonal as diagonal
from .operators.masks_and_lift import identity as identity
from .operators.masks_and_lift import interior as interior
from .operators.masks_and_lift import lift as lift
from .operators.masks_and_lift import mask as mask
from .operators.operator import Operator as Operator
from .operators.transfer import average as average
from .operators.transfer import component as component
from .operators.transfer import prolong as prolong
from .operators.transfer import restrict as restrict
from .operators.transfer import sample as sample
from .optimize.constraints import equal as equal
from .optimize.laplace import laplace as laplace
from .optimize.minimize import minimize as minimize
from .optimize.physical_gradient import physical_gradient as physical_gradient
from .optimize.regularization import smoothness as smoothness
from .optimize.regularization import total_variation as total_variation
from .optimize.update_direction import update_direction as update_direction
from .parallel.distribute import distribute as distribute
from .parallel.distribute import gather as gather
from .parallel.scenes import ensemble as ensemble
from .report.certificate import certified as certified
from .report.certificate import certify as certify
from .report.explain import explain as explain
from .report.plots import animate as animate
from .report.plots import convergence as convergence
from .report.plots import plot as plot
from .report.plots import v_curve as v_curve
from .report.stress_table import stress as stress
from .report.work_precision import work_precision as work_precision
from .solvers.eigenpairs import eigenpairs as eigenpairs
from .solvers.inverse import inverse as inverse
from .solvers.parametric import elliptic_solver as elliptic_solver
from .solvers.parametric import matrix_solver as matrix_solver
from .solvers.roots import implicit as implicit
from .solvers.roots import steady as steady
from .solvers.spectral import matrix_exponential as matrix_exponential
from .solvers.spectral import matrix_function as matrix_function
from .solvers.spectral import matrix_power as matrix_power
from .trajectory.rollout import rollout as rollout

__version__: str

# deprecated names
adopt = from_blackbox
exponential = matrix_exponential
function = matrix_function
power = matrix_power
workprec = work_precision
