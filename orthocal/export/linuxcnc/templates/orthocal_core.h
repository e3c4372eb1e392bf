/* Calibrated kinematics of $robot. Plain C99; no memory allocation; needs $functions only.
   Lengths in mm, joints in $joint_units: $joints. */
#ifndef ORTHOCAL_CORE_H
#define ORTHOCAL_CORE_H

#define ORTHOCAL_DRIVES $drives

/* Inverse kinematics: joints for a point of the tool. Returns 0, or -1 if the legs do not reach the
   point; joints are unchanged then. */
int orthocal_inverse(const double point[ORTHOCAL_DRIVES], double joints[ORTHOCAL_DRIVES]);

/* Forward kinematics: point of the tool, by iteration from the value of point. Returns 0, or -1 if the
   joints have no point; point is unchanged then. */
int orthocal_forward(const double joints[ORTHOCAL_DRIVES], double point[ORTHOCAL_DRIVES]);

#endif
