/* A LinuxCNC kinematics module around orthocal_core.c; see README.md beside it.
   Build: sudo halcompile --install orthocal_kins.c */
#include "rtapi.h"
#include "rtapi_app.h"
#include "hal.h"
#include "kinematics.h"
#include "orthocal_core.c"

#define LETTERS 6

/* coordinates that the drives command (x = 0), and those that equal the joints after the drives */
static const int commanded[N] = $commanded;
static const int identity[LETTERS - N] = $identity;

#if ORTHOCAL_THERMAL
static struct {
    hal_float_t *temperature;
} *pins;

static void read_pins(void)
{
    orthocal_set_temperature(*pins->temperature);
}
#else
static void read_pins(void)
{
}
#endif

static double *coordinate(EmcPose *world, int letter)
{
    switch (letter) {
    case 0: return &world->tran.x;
    case 1: return &world->tran.y;
    case 2: return &world->tran.z;
    case 3: return &world->a;
    case 4: return &world->b;
    default: return &world->c;
    }
}

int kinematicsForward(const double *joints, EmcPose *world,
                      const KINEMATICS_FORWARD_FLAGS *fflags,
                      KINEMATICS_INVERSE_FLAGS *iflags)
{
    double point[N];
    int i;

    (void)fflags;
    (void)iflags;
    read_pins();
    for (i = 0; i < N; i++)
        point[i] = *coordinate(world, commanded[i]);
    if (orthocal_forward(joints, point) != 0)
        return -1;
    for (i = 0; i < N; i++)
        *coordinate(world, commanded[i]) = point[i];
    for (i = 0; i < LETTERS - N; i++)
        *coordinate(world, identity[i]) = joints[N + i];
    world->u = world->v = world->w = 0.0;
    return 0;
}

int kinematicsInverse(const EmcPose *world, double *joints,
                      const KINEMATICS_INVERSE_FLAGS *iflags,
                      KINEMATICS_FORWARD_FLAGS *fflags)
{
    EmcPose pose = *world;
    double point[N];
    int i;

    (void)iflags;
    (void)fflags;
    read_pins();
    for (i = 0; i < N; i++)
        point[i] = *coordinate(&pose, commanded[i]);
    if (orthocal_inverse(point, joints) != 0)
        return -1;
    for (i = 0; i < LETTERS - N; i++)
        joints[N + i] = *coordinate(&pose, identity[i]);
    return 0;
}

KINEMATICS_TYPE kinematicsType(void)
{
    return KINEMATICS_BOTH;
}

KINS_NOT_SWITCHABLE
EXPORT_SYMBOL(kinematicsType);
EXPORT_SYMBOL(kinematicsForward);
EXPORT_SYMBOL(kinematicsInverse);
MODULE_LICENSE("Dual BSD/GPL");

static int component;

/* Pins of the module; 0, or less than 0 without memory. */
static int make_pins(void)
{
#if ORTHOCAL_THERMAL
    int failed;

    pins = hal_malloc(sizeof(*pins));
    if (!pins)
        return -1;
    failed = hal_pin_float_newf(HAL_IN, &pins->temperature, component, "orthocal.temperature");
    if (failed)
        return failed;
    *pins->temperature = ORTHOCAL_REFERENCE;
#endif
    return 0;
}

int rtapi_app_main(void)
{
    int failed;

    component = hal_init("orthocal_kins");
    if (component < 0)
        return component;
    failed = make_pins();
    if (failed) {
        hal_exit(component);
        return failed;
    }
    hal_ready(component);
    return 0;
}

void rtapi_app_exit(void)
{
    hal_exit(component);
}
