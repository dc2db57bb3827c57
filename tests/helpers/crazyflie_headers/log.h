/* Tables as the firmware makes them, so that a wrong address or name fails to compile. */
#pragma once
struct log_s {
    int type;
    const char *name;
    void *address;
};
enum { LOG_UINT8, LOG_UINT16, LOG_UINT32, LOG_FLOAT };
#define LOG_GROUP_START(group) static const struct log_s logs_##group[] __attribute__((used)) = {
#define LOG_ADD(kind, variable, place) {.type = kind, .name = #variable, .address = (void *)(place)},
#define LOG_GROUP_STOP(group) {.name = #group}};
