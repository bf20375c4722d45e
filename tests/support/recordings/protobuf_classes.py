"""Google's own implementation of our message types, built from our embedded descriptors."""

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from motorhil.traces.protobuf import file_descriptor_set


def google_class(message):
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(file_descriptor_set(message)).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(message.name))
