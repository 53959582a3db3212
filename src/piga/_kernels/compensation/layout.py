"""Positions in the flat arrays of the compensation kernels.

The kernels use one flat work array with rows of ``STRIDE`` numbers. All rows have one base, so the compiler sees that they
do not overlap. Entry 0 of a row is the last sample (or interval) before the block. Entry ``j`` belongs
to sample ``j - 1`` of the block, or to the interval that ends at this sample.
"""

from __future__ import annotations

BLOCK = 1024
"""Samples per block, a multiple of ``TILE``; the rows in use then stay in the fast caches."""
TILE = 64
"""The loops with contracted arithmetic run over a multiple of this many samples; the last sample is repeated. They
have no remainder loop, so the result of a sample does not depend on its position in a chunk."""
PAST = 8
STRIDE = BLOCK + TILE + PAST
"""A row has space for one block and one tile. Entries -1, -2, ... of a row hold the samples before entry 0. They lie in
the spare end of the previous row."""

SPARE = 0 * STRIDE  # its end is the past of the row behind it
PSI = 1 * STRIDE
RATE_Y = 2 * STRIDE  # tan_beta u_Y (+ harmonic) [rad/s]
RATE_Z = 3 * STRIDE
FORCE_Y = 4 * STRIDE  # reference [m/s^2]
FORCE_Z = 5 * STRIDE
OMEGA_X = 6 * STRIDE  # base rate about X0 [rad/s]
WARMTH = 7 * STRIDE  # temperature less its reference [K]
STEP = 8 * STRIDE  # interval [s]; 0 where no increment is formed
FIRST = 9 * STRIDE  # mean u_x [rad/s]
SINE = 10 * STRIDE  # of the effective angle
COSINE = 11 * STRIDE
SLOPE = 12 * STRIDE  # change of a_x over the interval [m/s^2]
INPUT = 13 * STRIDE  # indicated mean specific force along X0 [m/s^2]
FORCE = 14 * STRIDE  # compensated a_x [m/s^2]
CONSTANT = 15 * STRIDE  # mean u_x if the input were constant in the interval [rad/s]
TURN = 16 * STRIDE  # output rate over K [m/s^2]
MEAN_Y = 17 * STRIDE
MEAN_Z = 18 * STRIDE
CHANGE_Y = 19 * STRIDE
CHANGE_Z = 20 * STRIDE
MEAN_T = 21 * STRIDE
CHANGE_T = 22 * STRIDE
MEAN_TIME = 23 * STRIDE
DERIVATIVE = 24 * STRIDE  # of a_x by the indicated force [1]
KNOWN_TO = 25 * STRIDE  # standard uncertainty of a_x [m/s^2]
SQUARE = 26 * STRIDE
PARTIAL = 27 * STRIDE
ANGLE = 28 * STRIDE  # effective angle [rad]
INVERSE = 29 * STRIDE  # 1/STEP [1/s]; 0 where no increment is formed
AXIS_X, AXIS_Y, AXIS_Z = 30 * STRIDE, 31 * STRIDE, 32 * STRIDE  # sets: effective axis in the common frame
HALF = 33 * STRIDE  # sets: half the angle turned [rad], or the rate [rad/s]
GAIN = 34 * STRIDE  # sin(delta)/delta, delta half the angle turned
BASE_X, BASE_Y, BASE_Z = 35 * STRIDE, 36 * STRIDE, 37 * STRIDE  # sets: what base rate and harmonics add [rad/s]
ERROR = 38 * STRIDE  # sets: error model at the force [m/s^2]
HARMONICS = 39 * STRIDE  # sets: second and higher harmonics [m/s^2]
ANGLE_TURNED = 40 * STRIDE  # A: integral of u_x over the interval [rad]
TIME = 41 * STRIDE
NODE_SINE, NODE_COSINE = 42 * STRIDE, 43 * STRIDE  # of the angle read at the samples
COUPLING = 44 * STRIDE  # tan_beta (u_Y sin - u_Z cos) at the samples [rad/s]
ACROSS = 45 * STRIDE  # tan_beta (u_Y cos + u_Z sin) at the samples [rad/s]
EARLY = 46 * STRIDE  # mean u_x by the trapezoid of the coupling [rad/s]
PER = 47 * STRIDE  # 1 over the time that a row stands for in the noise [1/s]
FAR_INPUT, FAR_SLOPE = 48 * STRIDE, 49 * STRIDE  # INPUT and SLOPE of intervals that turn far
# sets: changes of BASE over the interval
BASE_RISE_X, BASE_RISE_Y, BASE_RISE_Z = 50 * STRIDE, 51 * STRIDE, 52 * STRIDE
ERROR_RISE = 53 * STRIDE  # sets: change of ERROR over the interval [m/s^2]
# mean over the interval less that of both ends, of OMEGA_X, RATE_Y and RATE_Z [rad/s]
BOW_X, BOW_Y, BOW_Z = 54 * STRIDE, 55 * STRIDE, 56 * STRIDE
# standard uncertainty of the bows [rad/s]
LEFT_X, LEFT_Y, LEFT_Z = 57 * STRIDE, 58 * STRIDE, 59 * STRIDE
DOUBT = 60 * STRIDE  # uncertainty of the mean force of the interval by changes between samples [m/s^2]
OMEGA_Y, OMEGA_Z = 61 * STRIDE, 62 * STRIDE  # base rate across [rad/s]
CURVED = 63 * STRIDE  # second derivative of an input by the sample of a row and the two before it
WEIGHT_CURVED = 64 * STRIDE  # 2 over the time of two intervals [1/s]; 0 where they do not belong together
AHEAD = 65 * STRIDE  # by how much of the last change a second derivative goes on to the middle of its interval
REGRESSORS = 66 * STRIDE
MOST_TERMS = 40
WORK = (66 + MOST_TERMS) * STRIDE

P_K = 0
P_TAN_BETA = 1
P_PHI = 2
P_OFFSET_Y = 3  # K s1 [rad/s]
P_OFFSET_Z = 4  # -K c1 [rad/s]
P_TIME_REFERENCE = 5
P_TEMPERATURE_REFERENCE = 6
P_WHITE = 7  # variance of the white angle noise [rad^2]
P_WALK = 8  # of the random walk [rad^2/s]
P_TERMS = 10  # coefficients by code, CODES below
TERMS = (
    "k0", "k1", "k2", "k3", "k2o", "m_Y", "m_Z", "k_XY", "k_XZ", "k_YY", "k_ZZ", "k_YZ", "k0_t", "k0_T", "k1_T",
    "servo", "servo_damping",
)  # fmt: skip
"""Terms of the error model in the order of their codes; SI."""
SCALE_FACTOR = 40  # codes behind those of the terms
TAN_BETA = 41
PHI = 42
HARMONIC = 100  # 100 + 2 n sine, 101 + 2 n cosine of order n
PARAMETERS = 32

S_VALID = 0  # 1 once a sample has been seen
S_TIME = 1
S_PSI = 2
S_FORCE_Y = 3
S_FORCE_Z = 4
S_OMEGA_X = 5
S_OMEGA_Y = 6
S_OMEGA_Z = 7
S_WARMTH = 8
S_FIRST = 10
S_FORCE = 11
S_TURNS = 12  # rate logs: whole turns and rest of alpha
S_REST = 13
S_START = 14  # published formula: psi of the first sample
S_PHI = 15  # phase that is contained in S_REST
S_NOMINAL = 16  # nominal interval [s] to detect gaps; 0 until known
S_PSI_BEFORE = 17  # angle one sample before the last
S_SLOPE = 18  # change of a_x over the last interval
S_DOUBT = 19
S_EARLY = 20  # mean u_x of the last three intervals, the latest first
S_STEPS = 23  # their lengths
S_OMEGA_X_BEFORE = 26  # base rate and transverse input, one and two samples before the last
S_RATE_Y_BEFORE = 28
S_RATE_Z_BEFORE = 30
STATE = 32

EXACT, PUBLISHED = 0, 1

NO_INCREMENT = 1
LOCKED = 2
NEAR_CRITICAL = 4
OUT_OF_RANGE = 8
TEMPERATURE = 16
AGE = 32
COARSE = 64
FAULT = 256
