/* A GenTL producer for GigE Vision cameras, on Aravis: what a maker's .cti does, as far as harvesters asks.
 *
 * It lets the tests drive the harvesters driver against the simulated camera over the real wire. Handles are
 * pointers to the structures below; names, numbers and layouts are those of the GenTL standard 1.5.
 *
 *   gcc -shared -fPIC -o gige.cti gige_producer.c -l:libaravis-0.8.so.0 -lgobject-2.0 -lglib-2.0 -Wl,-z,nodelete
 */
#include <glib-object.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SUCCESS = 0, FAILED = -1001, NOT_IMPLEMENTED = -1003, IN_USE = -1004, NO_SUCH_ID = -1007, BAD_IO = -1010,
       TIMED_OUT = -1011, NOT_AVAILABLE = -1014, TOO_SMALL = -1016 };
enum { STRING = 1, INT32 = 5, UINT32 = 6, UINT64 = 8, POINTER = 10, BOOL8 = 11, SIZE = 12 };

typedef enum { MODULE, REMOTE } Kind;
typedef struct { Kind kind; void *device; const char *xml; size_t xml_size; } Port;
typedef struct { Kind kind; Port remote; void *camera; char serial[64]; } Device;
typedef struct { Kind kind; Device *device; void *stream; GList *announced, *queued; } Stream;
typedef struct { void *memory, *user, *arv; size_t size; } Frame;

void arv_update_device_list(void);
unsigned arv_get_n_devices(void);
const char *arv_get_device_serial_nbr(unsigned), *arv_get_device_vendor(unsigned), *arv_get_device_model(unsigned);
const char *arv_get_device_address(unsigned);
void *arv_camera_new(const char *, GError **), *arv_camera_get_device(void *);
void *arv_camera_create_stream(void *, void *, void *, GError **);
int arv_gv_device_is_controller(void *);
int arv_device_read_memory(void *, uint64_t, uint32_t, void *, GError **);
int arv_device_write_memory(void *, uint64_t, uint32_t, const void *, GError **);
const char *arv_device_get_genicam_xml(void *, size_t *);
void *arv_buffer_new_full(size_t, void *, void *, GDestroyNotify);
const void *arv_buffer_get_user_data(void *), *arv_buffer_get_data(void *, size_t *);
int arv_buffer_get_status(void *), arv_buffer_get_image_width(void *), arv_buffer_get_image_height(void *);
uint64_t arv_buffer_get_timestamp(void *), arv_buffer_get_frame_id(void *);
uint32_t arv_buffer_get_image_pixel_format(void *);
void arv_stream_push_buffer(void *, void *), *arv_stream_timeout_pop_buffer(void *, uint64_t);
void *arv_stream_try_pop_buffer(void *);
uint64_t arv_stream_get_info_uint64_by_name(void *, const char *);

static const uint64_t XML_ADDRESS = 1ull << 63; /* beyond every register of a camera */
static int initialized;
static Kind system_handle = MODULE, interface_handle = MODULE;

static int put(int32_t kind, const void *value, size_t size, int32_t *type, void *out, size_t *room) {
    if (type) *type = kind;
    if (out && *room < size) return TOO_SMALL;
    if (out) memcpy(out, value, size);
    *room = size;
    return SUCCESS;
}
static int put_text(const char *text, int32_t *type, void *out, size_t *room) {
    return put(STRING, text, strlen(text) + 1, type, out, room);
}
static int put_number(int32_t kind, uint64_t value, int32_t *type, void *out, size_t *room) {
    size_t size = kind == BOOL8 ? 1 : kind == INT32 || kind == UINT32 ? 4 : 8;
    return put(kind, &value, size, type, out, room); /* little-endian, as all that run this are */
}
static int answer(GError *error) {
    if (!error) return SUCCESS;
    g_error_free(error);
    return BAD_IO;
}
static int index_of(const char *serial) {
    for (unsigned i = 0; i < arv_get_n_devices(); i++)
        if (!strcmp(arv_get_device_serial_nbr(i), serial)) return (int)i;
    return -1;
}

int GCInitLib(void) { return initialized++ ? (initialized = 1, IN_USE) : SUCCESS; }
int GCCloseLib(void) { initialized = 0; return SUCCESS; }
int GCGetInfo(int32_t what, int32_t *type, void *out, size_t *room) {
    if (what == 9 || what == 10) return put_number(UINT32, what == 9 ? 1 : 5, type, out, room);
    if (what == 8) return put_number(INT32, 1, type, out, room);
    return put_text(what == 4 ? "GEV" : "gige", type, out, room);
}
int GCGetLastError(int32_t *code, char *text, size_t *room) {
    *code = FAILED;
    return put_text("refused", 0, text, room);
}

int TLOpen(void **handle) { *handle = &system_handle; return SUCCESS; }
int TLClose(void *handle) { return SUCCESS; }
int TLGetInfo(void *handle, int32_t what, int32_t *type, void *out, size_t *room) {
    return GCGetInfo(what, type, out, room);
}
int TLUpdateInterfaceList(void *handle, uint8_t *changed, uint64_t timeout) {
    if (changed) *changed = 0;
    return SUCCESS;
}
int TLGetNumInterfaces(void *handle, uint32_t *count) { *count = 1; return SUCCESS; }
int TLGetInterfaceID(void *handle, uint32_t index, char *id, size_t *room) { return put_text("all", 0, id, room); }
int TLGetInterfaceInfo(void *handle, const char *id, int32_t what, int32_t *type, void *out, size_t *room) {
    return put_text(what == 2 ? "GEV" : "all", type, out, room);
}
int TLOpenInterface(void *handle, const char *id, void **interface) {
    *interface = &interface_handle;
    return SUCCESS;
}

int IFClose(void *handle) { return SUCCESS; }
int IFGetInfo(void *handle, int32_t what, int32_t *type, void *out, size_t *room) {
    return TLGetInterfaceInfo(0, 0, what, type, out, room);
}
int IFGetParentTL(void *handle, void **parent) { *parent = &system_handle; return SUCCESS; }
int IFUpdateDeviceList(void *handle, uint8_t *changed, uint64_t timeout) {
    if (!arv_get_n_devices()) arv_update_device_list(); /* takes a second; a test's camera keeps its address */
    if (changed) *changed = 1;
    return SUCCESS;
}
int IFGetNumDevices(void *handle, uint32_t *count) { *count = arv_get_n_devices(); return SUCCESS; }
int IFGetDeviceID(void *handle, uint32_t index, char *id, size_t *room) {
    return index < arv_get_n_devices() ? put_text(arv_get_device_serial_nbr(index), 0, id, room) : NO_SUCH_ID;
}
int IFGetDeviceInfo(void *handle, const char *id, int32_t what, int32_t *type, void *out, size_t *room) {
    int index = index_of(id);
    if (index < 0) return NO_SUCH_ID;
    switch (what) {
    case 1: return put_text(arv_get_device_vendor(index), type, out, room);
    case 2: return put_text(arv_get_device_model(index), type, out, room);
    case 3: return put_text("GEV", type, out, room);
    case 5: return put_number(INT32, 0, type, out, room);
    case 0: case 4: case 7: return put_text(id, type, out, room);
    case 9: return put_number(UINT64, 1000000000, type, out, room);
    default: return NOT_AVAILABLE;
    }
}
int IFOpenDevice(void *handle, const char *id, int32_t access, void **opened) {
    int index = index_of(id);
    if (index < 0) return NO_SUCH_ID;
    void *camera = arv_camera_new(arv_get_device_address(index), NULL);
    if (!camera) return BAD_IO;
    Device *device = calloc(1, sizeof *device);
    *device = (Device){.camera = camera, .remote = {REMOTE, arv_camera_get_device(camera)}};
    snprintf(device->serial, sizeof device->serial, "%s", id);
    device->remote.xml = arv_device_get_genicam_xml(device->remote.device, &device->remote.xml_size);
    *opened = device;
    if (arv_gv_device_is_controller(device->remote.device)) return SUCCESS;
    g_object_unref(camera);
    free(device);
    return IN_USE;
}

int DevClose(Device *device) { g_object_unref(device->camera); free(device); return SUCCESS; }
int DevGetPort(Device *device, void **port) { *port = &device->remote; return SUCCESS; }
int DevGetInfo(Device *device, int32_t what, int32_t *type, void *out, size_t *room) {
    return IFGetDeviceInfo(0, device->serial, what, type, out, room);
}
int DevGetParentIF(Device *device, void **parent) { *parent = &interface_handle; return SUCCESS; }
int DevGetNumDataStreams(Device *device, uint32_t *count) { *count = 1; return SUCCESS; }
int DevGetDataStreamID(Device *device, uint32_t index, char *id, size_t *room) {
    return put_text("stream", 0, id, room);
}
int DevOpenDataStream(Device *device, const char *id, void **opened) {
    Stream *stream = calloc(1, sizeof *stream);
    stream->device = device;
    *opened = stream;
    return SUCCESS;
}

/* Ports: only the remote device's has registers; that of every other module has a description of nothing. */
static const char NOTHING[] =
    "<?xml version='1.0' encoding='utf-8'?><RegisterDescription ModelName='module' VendorName='test'"
    " StandardNameSpace='None' SchemaMajorVersion='1' SchemaMinorVersion='1' SchemaSubMinorVersion='0'"
    " MajorVersion='1' MinorVersion='0' SubMinorVersion='0' ToolTip='' ProductGuid='0' VersionGuid='0'"
    " xmlns='http://www.genicam.org/GenApi/Version_1_1'><Category Name='Root'/><Port Name='module'/>"
    "</RegisterDescription>";
static const char *xml_of(Port *port) { return port->kind == REMOTE ? port->xml : NOTHING; }
int GCReadPort(Port *port, uint64_t address, void *out, size_t *size) {
    GError *error = NULL;
    if (address >= XML_ADDRESS) memcpy(out, xml_of(port) + (address - XML_ADDRESS), *size);
    else if (port->kind != REMOTE) return NOT_IMPLEMENTED;
    else arv_device_read_memory(port->device, address, *size, out, &error);
    return answer(error);
}
int GCWritePort(Port *port, uint64_t address, const void *in, size_t *size) {
    GError *error = NULL;
    if (port->kind != REMOTE) return NOT_IMPLEMENTED;
    arv_device_write_memory(port->device, address, *size, in, &error);
    return answer(error);
}
int GCGetNumPortURLs(Port *port, uint32_t *count) { *count = 1; return SUCCESS; }
int GCGetPortURLInfo(Port *port, uint32_t index, int32_t what, int32_t *type, void *out, size_t *room) {
    char url[96];
    size_t size = port->kind == REMOTE ? port->xml_size : strlen(NOTHING);
    if (what != 0) return NOT_IMPLEMENTED;
    snprintf(url, sizeof url, "local:%s.xml;%llx;%zx", port->kind == REMOTE ? "camera" : "module",
             (unsigned long long)XML_ADDRESS, size);
    return put_text(url, type, out, room);
}
int GCGetPortURL(Port *port, char *url, size_t *room) { return GCGetPortURLInfo(port, 0, 0, NULL, url, room); }
int GCGetPortInfo(Port *port, int32_t what, int32_t *type, void *out, size_t *room) {
    if (what >= 5 && what <= 10) return put_number(BOOL8, what != 5 && what < 9, type, out, room);
    return put_text(what == 3 ? "GEV" : port->kind == REMOTE ? "Device" : "module", type, out, room);
}

int DSAnnounceBuffer(Stream *stream, void *memory, size_t size, void *user, void **handle) {
    Frame *frame = calloc(1, sizeof *frame);
    *frame = (Frame){.memory = memory, .user = user, .size = size};
    frame->arv = arv_buffer_new_full(size, memory, frame, NULL);
    stream->announced = g_list_append(stream->announced, frame);
    *handle = frame;
    return SUCCESS;
}
int DSQueueBuffer(Stream *stream, Frame *frame) {
    if (stream->stream) arv_stream_push_buffer(stream->stream, g_object_ref(frame->arv));
    else stream->queued = g_list_append(stream->queued, frame);
    return SUCCESS;
}
int DSFlushQueue(Stream *stream, int32_t operation) {
    g_list_free(stream->queued);
    stream->queued = NULL;
    return SUCCESS;
}
int DSRevokeBuffer(Stream *stream, Frame *frame, void **memory, void **user) {
    if (memory) *memory = frame->memory;
    if (user) *user = frame->user;
    stream->announced = g_list_remove(stream->announced, frame);
    g_object_unref(frame->arv);
    free(frame);
    return SUCCESS;
}
int DSStartAcquisition(Stream *stream, int32_t flags, uint64_t count) {
    GError *error = NULL;
    stream->stream = arv_camera_create_stream(stream->device->camera, NULL, NULL, &error);
    if (!stream->stream) return answer(error);
    for (GList *item = stream->queued; item; item = item->next) DSQueueBuffer(stream, item->data);
    return DSFlushQueue(stream, 4);
}
int DSStopAcquisition(Stream *stream, int32_t flags) { g_clear_object(&stream->stream); return SUCCESS; }
int DSClose(Stream *stream) { DSStopAcquisition(stream, 1); DSFlushQueue(stream, 4); free(stream); return SUCCESS; }
int DSGetParentDev(Stream *stream, void **parent) { *parent = stream->device; return SUCCESS; }
static uint64_t underruns(Stream *stream) {
    return stream->stream ? arv_stream_get_info_uint64_by_name(stream->stream, "n_underruns") : 0;
}
int DSGetInfo(Stream *stream, int32_t what, int32_t *type, void *out, size_t *room) {
    switch (what) {
    case 0: return put_text("stream", type, out, room);
    case 2: return put_number(UINT64, underruns(stream), type, out, room);
    case 3: return put_number(SIZE, g_list_length(stream->announced), type, out, room);
    case 8: return put_number(BOOL8, stream->stream != NULL, type, out, room);
    case 9: return put_number(BOOL8, 0, type, out, room);
    case 10: return put_text("GEV", type, out, room);
    case 12: return put_number(SIZE, 1, type, out, room);
    default: return NOT_AVAILABLE;
    }
}
int DSGetBufferID(Stream *stream, uint32_t index, void **handle) {
    *handle = g_list_nth_data(stream->announced, index);
    return *handle ? SUCCESS : NO_SUCH_ID;
}
int DSGetBufferInfo(Stream *stream, Frame *frame, int32_t what, int32_t *type, void *out, size_t *room) {
    size_t filled = 0;
    int whole = arv_buffer_get_status(frame->arv) == 0;
    switch (what) {
    case 0: return put(POINTER, &frame->memory, sizeof frame->memory, type, out, room);
    case 1: return put_number(SIZE, frame->size, type, out, room);
    case 2: return put(POINTER, &frame->user, sizeof frame->user, type, out, room);
    case 3: case 28: return put_number(UINT64, arv_buffer_get_timestamp(frame->arv), type, out, room);
    case 7: return put_number(BOOL8, !whole, type, out, room);
    case 8: return put_text("GEV", type, out, room);
    case 9: case 27:
        if (whole) arv_buffer_get_data(frame->arv, &filled);
        return put_number(SIZE, filled, type, out, room);
    case 16: return put_number(UINT64, arv_buffer_get_frame_id(frame->arv), type, out, room);
    case 17: return put_number(BOOL8, whole, type, out, room);
    case 12: case 13: case 14: case 15: case 18: return put_number(SIZE, 0, type, out, room);
    case 19: return put_number(SIZE, 1, type, out, room);
    case 21: return put_number(UINT64, 4, type, out, room);
    case 30: return put_number(BOOL8, 0, type, out, room);
    }
    if (!whole) return NOT_AVAILABLE;
    switch (what) {
    case 10: return put_number(SIZE, arv_buffer_get_image_width(frame->arv), type, out, room);
    case 11: case 22: return put_number(SIZE, arv_buffer_get_image_height(frame->arv), type, out, room);
    case 20: return put_number(UINT64, arv_buffer_get_image_pixel_format(frame->arv), type, out, room);
    default: return NOT_AVAILABLE;
    }
}

int GCRegisterEvent(void *source, int32_t kind, void **event) {
    *event = source;
    return kind == 1 ? SUCCESS : NOT_IMPLEMENTED;
}
int GCUnregisterEvent(void *source, int32_t kind) { return SUCCESS; }
int EventGetData(Stream *stream, void *out, size_t *room, uint64_t timeout_ms) {
    void *popped = !stream->stream ? NULL : timeout_ms == 0 ? arv_stream_try_pop_buffer(stream->stream)
                   : arv_stream_timeout_pop_buffer(stream->stream, timeout_ms > 60000 ? 60000000 : 1000 * timeout_ms);
    if (!popped) return TIMED_OUT;
    Frame *frame = (Frame *)arv_buffer_get_user_data(popped);
    g_object_unref(popped); /* its announcement holds it */
    void *data[2] = {frame, frame->user};
    return put(POINTER, data, sizeof data, NULL, out, room);
}
int EventGetDataInfo(Stream *stream, const void *in, size_t size, int32_t what, int32_t *type, void *out,
                     size_t *room) {
    return put(POINTER, (const char *)in + (what == 1 ? sizeof(void *) : 0), sizeof(void *), type, out, room);
}
int EventGetInfo(Stream *stream, int32_t what, int32_t *type, void *out, size_t *room) {
    if (what == 0) return put_number(INT32, 1, type, out, room);
    return put_number(SIZE, what == 1 ? 0 : 2 * sizeof(void *), type, out, room);
}
int EventFlush(Stream *stream) { return SUCCESS; }
int EventKill(Stream *stream) { return SUCCESS; }

#define ABSENT(name) int name(void) { return NOT_IMPLEMENTED; }
ABSENT(GCReadPortStacked) ABSENT(GCWritePortStacked) ABSENT(DSAllocAndAnnounceBuffer) ABSENT(DSGetBufferChunkData)
ABSENT(DSGetNumBufferParts) ABSENT(DSGetBufferPartInfo)
