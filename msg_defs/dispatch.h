// Type supports that lead to those of Fast DDS and of introspection, as the generated code of
// rosidl_typesupport_c does, but in the same library: nothing is loaded by its name.

#include <string.h>

#include "rosidl_runtime_c/message_type_support_struct.h"
#include "rosidl_runtime_c/service_type_support_struct.h"
#include "rosidl_typesupport_c/identifier.h"

#define HANDLE(library, kind, type) library##__get_##kind##_type_support_handle__##type

// Defines the dispatcher of one message or service; `kind` is message or service.
#define DISPATCH(kind, type, complete) \
    typedef rosidl_##kind##_type_support_t type##__support; \
    const type##__support *HANDLE(rosidl_typesupport_fastrtps_c, kind, type)(void); \
    const type##__support *HANDLE(rosidl_typesupport_introspection_c, kind, type)(void); \
    static const type##__support *type##__find(const type##__support *handle, const char *name) { \
        const type##__support *found = HANDLE(rosidl_typesupport_fastrtps_c, kind, type)(); \
        (void)handle; \
        if (strcmp(found->typesupport_identifier, name) == 0) return found; \
        found = HANDLE(rosidl_typesupport_introspection_c, kind, type)(); \
        return strcmp(found->typesupport_identifier, name) == 0 ? found : NULL; \
    } \
    const type##__support *HANDLE(rosidl_typesupport_c, kind, type)(void) { \
        static type##__support handle; \
        if (handle.func == NULL) { \
            type##__support made = *HANDLE(rosidl_typesupport_fastrtps_c, kind, type)(); \
            made.typesupport_identifier = rosidl_typesupport_c__typesupport_identifier; \
            made.func = type##__find; \
            complete; \
            handle = made; \
        } \
        return &handle; \
    }

#define DISPATCH_MESSAGE(type) DISPATCH(message, type, (void)0)
#define DISPATCH_SERVICE(type) \
    DISPATCH_MESSAGE(type##_Request) \
    DISPATCH_MESSAGE(type##_Response) \
    DISPATCH_MESSAGE(type##_Event) \
    DISPATCH(service, type, \
             made.request_typesupport = HANDLE(rosidl_typesupport_c, message, type##_Request)(); \
             made.response_typesupport = HANDLE(rosidl_typesupport_c, message, type##_Response)(); \
             made.event_typesupport = HANDLE(rosidl_typesupport_c, message, type##_Event)())
