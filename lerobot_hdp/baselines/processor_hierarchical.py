"""LeRobot finds a policy's processors by its type and the module of its configuration: they are HDP's."""

from ..processor_hdp import make_hdp_pre_post_processors

make_hd_pre_post_processors = make_hdp_pre_post_processors
make_chd_pre_post_processors = make_hdp_pre_post_processors
