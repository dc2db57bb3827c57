#ifndef PLATFORM_H
#define PLATFORM_H
/* Stands for Indiflight's. */
#endif
