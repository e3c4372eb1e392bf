/* Kinematics of $robot as calibrated. Plain C99, no allocation, sqrt only.
   Lengths in mm, joints in $joint_units: $joints. */
#ifndef ORTHOCAL_CORE_H
#define ORTHOCAL_CORE_H

#define ORTHOCAL_DRIVES $drives

/* Where the joints belong for a point of the tool. 0, or -1 where the legs do not reach it, and joints
   are as they were. */
int orthocal_inverse(const double point[ORTHOCAL_DRIVES], double joints[ORTHOCAL_DRIVES]);

/* Where the tool is, by iteration from the point given. 0, or -1 where the joints have no point, and
   the point is as it was. */
int orthocal_forward(const double joints[ORTHOCAL_DRIVES], double point[ORTHOCAL_DRIVES]);

#endif
