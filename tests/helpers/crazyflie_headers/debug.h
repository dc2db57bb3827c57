#pragma once
int consolePrintf(const char *format, ...);
#define DEBUG_PRINT(format, ...) consolePrintf(DEBUG_MODULE ": " format, ##__VA_ARGS__)
