/* Functions that FMI 3.0 wants to exist and that nothing in this model needs: there are no variables of other types, no
   clocks and no directional derivatives. They are defined without a prototype, since they look at none of their arguments. */

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#define UNSUPPORTED(name) \
    EXPORT int name() { return 3; } /* fmi3Error */
#define ALL_TYPES(verb)                                                                                                \
    UNSUPPORTED(fmi3##verb##Float32)                                                                                   \
    UNSUPPORTED(fmi3##verb##Int8)                                                                                      \
    UNSUPPORTED(fmi3##verb##UInt8)                                                                                     \
    UNSUPPORTED(fmi3##verb##Int16)                                                                                     \
    UNSUPPORTED(fmi3##verb##UInt16)                                                                                    \
    UNSUPPORTED(fmi3##verb##Int32)                                                                                     \
    UNSUPPORTED(fmi3##verb##UInt32)                                                                                    \
    UNSUPPORTED(fmi3##verb##Int64)                                                                                     \
    UNSUPPORTED(fmi3##verb##UInt64)                                                                                    \
    UNSUPPORTED(fmi3##verb##Boolean)                                                                                   \
    UNSUPPORTED(fmi3##verb##String)                                                                                    \
    UNSUPPORTED(fmi3##verb##Binary)                                                                                    \
    UNSUPPORTED(fmi3##verb##Clock)                                                                                     \
    UNSUPPORTED(fmi3##verb##IntervalDecimal)                                                                           \
    UNSUPPORTED(fmi3##verb##IntervalFraction)                                                                          \
    UNSUPPORTED(fmi3##verb##ShiftDecimal)                                                                              \
    UNSUPPORTED(fmi3##verb##ShiftFraction)

ALL_TYPES(Get)
ALL_TYPES(Set)
UNSUPPORTED(fmi3GetNumberOfVariableDependencies)
UNSUPPORTED(fmi3GetVariableDependencies)
UNSUPPORTED(fmi3SerializedFMUStateSize)
UNSUPPORTED(fmi3SerializeFMUState)
UNSUPPORTED(fmi3DeserializeFMUState)
UNSUPPORTED(fmi3GetDirectionalDerivative)
UNSUPPORTED(fmi3GetAdjointDerivative)
UNSUPPORTED(fmi3GetOutputDerivatives)
UNSUPPORTED(fmi3ActivateModelPartition)

EXPORT void *fmi3InstantiateScheduledExecution() { return 0; }
