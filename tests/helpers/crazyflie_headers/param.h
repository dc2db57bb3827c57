#pragma once
struct param_s {
    int type;
    const char *name;
    void *address;
};
enum { PARAM_UINT8, PARAM_UINT16 };
#define PARAM_GROUP_START(group) static const struct param_s params_##group[] __attribute__((used)) = {
#define PARAM_ADD(kind, variable, place) {.type = kind, .name = #variable, .address = (void *)(place)},
#define PARAM_GROUP_STOP(group) {.name = #group}};
