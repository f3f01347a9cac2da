from setuptools import find_packages, setup

NAME = 'rtest_identification'

setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: [f'**/*.{kind}' for kind in ('yaml', 'html', 'css', 'js', 'j2')]},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    maintainer='R-test developers',
    maintainer_email='rtest@example.com',
    description='From finished cycles to error motions, maps, reports and the model gap.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'identifier = rtest_identification.nodes.identifier:main',
            'thermal = rtest_identification.nodes.thermal:main',
        ],
    },
)
