/* Calibrated kinematics of $robot. Plain C99; no memory allocation; needs $functions only.
   Lengths in mm, joints in $joint_units: $joints. */
#ifndef ORTHOCAL_CORE_H
#define ORTHOCAL_CORE_H

#define ORTHOCAL_DRIVES $drives

/* 1 if the joints depend on the temperature */
#define ORTHOCAL_THERMAL $thermal
#if ORTHOCAL_THERMAL
#define ORTHOCAL_REFERENCE $reference
#define ORTHOCAL_LOWEST $lowest
#define ORTHOCAL_HIGHEST $highest

/* Temperature of the machine for the calls that follow, degrees Celsius; the reference before the
   first call. Beyond the limits it is the nearest limit; what is not a number is the reference. */
void orthocal_set_temperature(double celsius);
#endif

/* Inverse kinematics: joints for a point of the tool. Returns 0, or -1 if the legs do not reach the
   point; joints are unchanged then. */
int orthocal_inverse(const double point[ORTHOCAL_DRIVES], double joints[ORTHOCAL_DRIVES]);

/* Forward kinematics: point of the tool, by iteration from the value of point. Returns 0, or -1 if the
   joints have no point; point is unchanged then. */
int orthocal_forward(const double joints[ORTHOCAL_DRIVES], double point[ORTHOCAL_DRIVES]);

#endif
